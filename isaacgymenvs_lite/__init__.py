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
    """Make a task; names and order of the arguments are IsaacGymEnvs', all have a default.

    torch computes on fewer threads while a task of few environments is open, and logs it; see
    `isaacgymenvs_lite.utils.threads`.

    Args:
        seed: seed for Python, numpy and torch; -1 draws one.
        task: name of a task file in cfg/task.
        num_envs: number of environments; '' means the task file's number.
        sim_device: has no effect, because the physics runs on the CPU; the log says so.
        rl_device: torch device of the tensors that `step` and `reset` return.
        graphics_device_id: index of the rendering device.
        headless: whether to open no window. With False the program ends with its window.
        multi_gpu: has no effect on a task.
        virtual_screen_capture: whether `render()` returns pictures. No window is opened then, and
            no display is needed.
        force_render: whether the window shows every step, not only the calls of `render`.
        cfg: a composed tree, which replaces task, num_envs and seed; `cfg.task.name` is the task.

    Returns:
        The task; call `close()` when done.

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
    """Register your own task for `name: <name>` of a task file; see docs/own_task.md.

    Its name in Gymnasium is `IsaacGymEnvsLite/<name>-v0`.

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
