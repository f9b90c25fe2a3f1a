"""The names of the package `gym`, for scripts that import gym without having it installed.

All names except `gym.wrappers.RecordVideo` are gymnasium's. Gymnasium's `RecordVideo` does not
work, because it needs environments whose `step` returns five values.
"""

from __future__ import annotations

from typing import Any

import gymnasium

from isaacgymenvs_lite.isaacgymenvs_compat import gym_wrappers as wrappers

__all__ = ["wrappers"]


def __getattr__(name: str) -> Any:
    return getattr(gymnasium, name)
