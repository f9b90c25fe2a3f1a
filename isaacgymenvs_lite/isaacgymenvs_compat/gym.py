"""The names of the package `gym`, for scripts that import gym without having it installed.

They are gymnasium's names, except `gym.wrappers.RecordVideo`, because gymnasium's class needs steps
that return five values.
"""

from __future__ import annotations

from typing import Any

import gymnasium

from isaacgymenvs_lite.isaacgymenvs_compat import gym_wrappers as wrappers

__all__ = ["wrappers"]


def __getattr__(name: str) -> Any:
    return getattr(gymnasium, name)
