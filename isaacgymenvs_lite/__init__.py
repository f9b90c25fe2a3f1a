"""IsaacGymEnvs' command line, YAML files and agents on MuJoCo, without a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

from isaacgymenvs_lite import gymnasium_ids
from isaacgymenvs_lite._version import __version__
from isaacgymenvs_lite.utils import openmp

if TYPE_CHECKING:
    from collections.abc import Callable

    from omegaconf import DictConfig

    from isaacgymenvs_lite.tasks.base.vec_task import VecTask

__all__ = ["__version__", "make", "register_task"]

openmp.let_threads_sleep()  # before anything here imports torch
gymnasium_ids.register_tasks()


def make(
    seed: int = 42,
    task: str = "HumanoidAMP",
    num_envs: int | str = "",
    sim_device: str = "cpu",
    rl_device: str = "cpu",
    graphics_device_id: int = -1,
    headless: bool = True,
    multi_gpu: bool = False,
    virtual_screen_capture: bool = False,
    force_render: bool = True,
    cfg: DictConfig | None = None,
) -> VecTask:
    """Make a task; IsaacGymEnvs has the same arguments in the same order. All have defaults.

    While a task of few environments is open, torch computes on fewer threads, which the log
    reports; see `isaacgymenvs_lite.utils.threads`.

    Args:
        seed: seed for Python, numpy and torch; -1 means that a seed is drawn.
        task: name of a task file in cfg/task.
        num_envs: number of environments; '' means the number in the task file.
        sim_device: has no effect, because the physics runs on the CPU; the log says so.
        rl_device: torch device of the tensors that `step` and `reset` return.
        graphics_device_id: index of the rendering device.
        headless: whether no window is opened. If a window is opened, closing it ends the program.
        multi_gpu: has no effect on a task.
        virtual_screen_capture: whether `render()` returns pictures. No window is opened then, and
            no display is needed.
        force_render: whether the window shows every step; otherwise it shows only the calls of
            `render`.
        cfg: a composed tree, which replaces task, num_envs and seed; `cfg.task.name` names the
            task.

    Returns:
        The task; the caller must call `close()` on the task in the end.

    Raises:
        ConfigError: a task, key or value is unknown.
        DeviceError: a device is misspelt, or this machine lacks the `rl_device`.
        RenderingError: `virtual_screen_capture` is set, but this machine cannot render.
        MotionFileError: a motion clip cannot be used.
    """
    from isaacgymenvs_lite.env_factory import make_task

    return make_task(
        seed=seed,
        task=task,
        num_envs=num_envs,
        sim_device=sim_device,
        rl_device=rl_device,
        graphics_device_id=graphics_device_id,
        headless=headless,
        multi_gpu=multi_gpu,
        virtual_screen_capture=virtual_screen_capture,
        force_render=force_render,
        cfg=cfg,
    )


def register_task(name: str, task: Callable[..., VecTask], *, replace: bool = False) -> None:
    """Register a user's task under the `name:` that task files use; see docs/own_task.md.

    The task's name in Gymnasium is `IsaacGymEnvsLite/<name>-v0`.

    Args:
        name: the task's name in task files.
        task: a subclass of `tasks.base.vec_task.VecTask`, or a function with the same keyword
            arguments that returns a task.
        replace: whether to replace a registered task of this name.

    Raises:
        ConfigError: another task has this name.
    """
    from isaacgymenvs_lite.tasks import registry

    registry.register_task(name, task, replace=replace)
