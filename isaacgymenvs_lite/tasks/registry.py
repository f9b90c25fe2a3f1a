"""Registry of the tasks that this package, programs and other installed packages define."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import cast

from isaacgymenvs_lite.config.compose import missing_task
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.gymnasium_ids import ENTRY_POINTS, register_task_id
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

TaskMaker = Callable[..., VecTask]

isaacgym_task_map: dict[str, TaskMaker] = {}
"""Maps the `name` in a task file to the class or function that makes the task."""


def register_task(name: str, task: TaskMaker, *, replace: bool = False) -> None:
    """Register a task under the `name` of its task file.

    Args:
        name: `name` in the task file.
        task: a class, or a function that returns a `VecTask` for the keyword arguments `cfg`,
            `rl_device`, `sim_device`, `graphics_device_id`, `headless`, `virtual_screen_capture`,
            `force_render`.
        replace: whether the task may replace a registered task of this name.

    Raises:
        ConfigError: another task has this name.
    """
    known = isaacgym_task_map.get(name)
    if known is not None and known is not task and not replace:
        raise ConfigError(
            f"register_task('{name}'): {known!r} already has this name; choose another name, or"
            " replace=True"
        )
    isaacgym_task_map[name] = task
    register_task_id(name)


def is_task(name: str) -> bool:
    """Return whether a task with this name exists. The task is not imported."""
    return name in isaacgym_task_map or name in {
        point.name for point in entry_points(group=ENTRY_POINTS)
    }


def find_task(name: str) -> TaskMaker:
    """Return the class or function that makes a task, after importing it if necessary.

    Raises:
        ConfigError: there is no such task, or its package cannot be imported.
    """
    if name in isaacgym_task_map:
        return isaacgym_task_map[name]
    offered = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    if name in offered:
        task = _load(offered[name])
        register_task(name, task)
        return task
    hint = (
        "add a task with isaacgymenvs_lite.register_task or an entry point of an installed package"
        " (docs/own_task.md)"
    )
    if (published := missing_task(name)) is not None:
        raise ConfigError(f"task.name: {published}; {hint}")
    raise ConfigError(unknown("task.name", name, {*isaacgym_task_map, *offered}, hint))


def _load(point: EntryPoint) -> TaskMaker:
    try:
        task = cast(TaskMaker, point.load())
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"task.name={point.name}: {point.value} of an installed package cannot be imported"
            f" ({error})"
        ) from error
    if not callable(task):
        raise ConfigError(
            f"task.name={point.name}: {point.value} of an installed package is no task class"
        )
    return task
