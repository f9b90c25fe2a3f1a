"""The names of the package `gym`, where only gymnasium is installed, for scripts with `import gym`.

They are gymnasium's, but for `gym.wrappers.RecordVideo`: gymnasium's own records environments that
return five values from a step.
"""

from __future__ import annotations

from typing import Any

import gymnasium

from isaacgymenvs_lite.isaacgymenvs_compat import gym_wrappers as wrappers

__all__ = ["wrappers"]


def __getattr__(name: str) -> Any:
    return getattr(gymnasium, name)
