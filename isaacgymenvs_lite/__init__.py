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
    """Make a task; arguments, names and order as IsaacGymEnvs' `make`, all with a default.

    While a task of few environments is open, torch computes on fewer threads and says so; see
    `isaacgymenvs_lite.utils.threads`.

    Args:
        seed: seeds Python, numpy and torch; -1 for a random seed.
        task: name of a task file in cfg/task.
        num_envs: number of environments; '' = the task file's own.
        sim_device: accepted for compatibility; the physics runs on the CPU, as the log says.
        rl_device: torch device of what `step` and `reset` return.
        graphics_device_id: index of the rendering device.
        headless: no window; with False the program ends when its window is closed, or by ESC.
        multi_gpu: of trainings; no effect on a task.
        virtual_screen_capture: open no window, even with `headless=False`; `render()` returns
            pictures, drawn without a display.
        force_render: show every step in the window; False: only when `render` is called.
        cfg: a composed tree to use instead of composing one; it then gives task, num_envs and
            seed, and `cfg.task.name` the class.

    Returns:
        The task; call `close()` when done.

    Raises:
        ConfigError: an unknown task, key or value.
        DeviceError: a misspelt device, or an `rl_device` that this machine does not have.
        RenderingError: `virtual_screen_capture`, and this machine cannot draw.
        MotionFileError: a motion clip that cannot be used.
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
        name: as in the task file.
        task: a subclass of `tasks.base.vec_task.VecTask`, or a function of the same keyword
            arguments that returns one.
        replace: replace a registered task of this name.

    Raises:
        ConfigError: another task has this name.
    """
    from isaacgymenvs_lite.tasks import registry

    registry.register_task(name, task, replace=replace)
