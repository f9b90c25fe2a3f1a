"""The names of `gym.wrappers`; see `isaacgymenvs_compat.gym`."""

from __future__ import annotations

from typing import Any

import gymnasium

from isaacgymenvs_lite.wrappers.task_video import TaskVideo as RecordVideo

__all__ = ["RecordVideo"]


def __getattr__(name: str) -> Any:
    return getattr(gymnasium.wrappers, name)
