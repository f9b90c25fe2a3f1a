"""The tasks, by the name that `task.name` in a task file gives."""

from __future__ import annotations

from collections.abc import Callable

from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

isaacgym_task_map: dict[str, Callable[..., VecTask]] = {
    "HumanoidAMP": HumanoidAMP,
}
