"""Tasks by name: of this package, added by a program, or offered by installed packages."""

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
"""Class of each task by the `name` of its task file."""


def register_task(name: str, task: TaskMaker, *, replace: bool = False) -> None:
    """Add a task that task files can name, `name: <name>`.

    Args:
        name: as in the task file.
        task: a class, or a function that makes a `VecTask` of the keyword arguments `cfg`,
            `rl_device`, `sim_device`, `graphics_device_id`, `headless`, `virtual_screen_capture`,
            `force_render`.
        replace: take the place of a task of this name.

    Raises:
        ConfigError: there is another task of this name.
    """
    known = isaacgym_task_map.get(name)
    if known is not None and known is not task and not replace:
        raise ConfigError(
            f"register_task('{name}'): there is a task of this name already, {known!r}; choose"
            " another name, or replace=True"
        )
    isaacgym_task_map[name] = task
    register_task_id(name)


def is_task(name: str) -> bool:
    """Return whether there is a task of this name; nothing is imported for it."""
    return name in isaacgym_task_map or name in {
        point.name for point in entry_points(group=ENTRY_POINTS)
    }


def find_task(name: str) -> TaskMaker:
    """Return what makes the task; an entry point is imported at its first use.

    Raises:
        ConfigError: there is no such task, or the package that offers it cannot be imported.
    """
    if name in isaacgym_task_map:
        return isaacgym_task_map[name]
    offered = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    if name in offered:
        task = _load(offered[name])
        register_task(name, task)
        return task
    hint = (
        "your own: isaacgymenvs_lite.register_task, or an entry point of an installed package"
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
            f"task.name={point.name}: the installed package offers it as {point.value}, which"
            f" cannot be imported ({error})"
        ) from error
    if not callable(task):
        raise ConfigError(
            f"task.name={point.name}: {point.value} of the installed package is no class of a task"
        )
    return task
