"""From arguments or a composed tree to a task."""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.config.seeds import resolve_seed
from isaacgymenvs_lite.rendering.display import check_display
from isaacgymenvs_lite.tasks import find_task
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.threads import limit_torch_threads, threads_for_envs
from isaacgymenvs_lite.watching.window import Window


def make_task(
    *,
    seed: int,
    task: str,
    num_envs: int | str,
    sim_device: str,
    rl_device: str,
    graphics_device_id: int,
    headless: bool,
    multi_gpu: bool,
    virtual_screen_capture: bool,
    force_render: bool,
    cfg: DictConfig | None,
) -> VecTask:
    """Make a task; see `isaacgymenvs_lite.make`."""
    if cfg is None:
        cfg = compose(
            [
                f"task={task}",
                f"num_envs={num_envs}" if num_envs != "" else "num_envs=''",
                f"seed={seed}",
                f"sim_device={sim_device}",
                f"rl_device={rl_device}",
                f"graphics_device_id={graphics_device_id}",
                f"headless={headless}",
                f"multi_gpu={multi_gpu}",
                f"force_render={force_render}",
            ]
        )
    settings = check_config(cfg)
    seed_everything(resolve_seed(settings.seed, settings.torch_deterministic))
    if not headless:
        check_display()
    env = make_from_config(
        cfg,
        sim_device=sim_device,
        rl_device=rl_device,
        graphics_device_id=graphics_device_id,
        headless=headless,
        virtual_screen_capture=virtual_screen_capture,
        force_render=force_render,
    )
    if not headless:
        # As in Isaac Gym, the program ends with its window.
        env.watchers.append(Window(env, Path("videos"), sys.exit, every_step=force_render))
    limit_torch_threads(env, threads_for_envs(env.num_envs), settings.num_threads)
    return env


def make_from_config(
    cfg: DictConfig,
    *,
    sim_device: str,
    rl_device: str,
    graphics_device_id: int = -1,
    headless: bool = True,
    virtual_screen_capture: bool = False,
    force_render: bool = False,
) -> VecTask:
    """Make the task that a composed tree describes.

    Raises:
        ConfigError: `cfg.task.name` is no task, or a key or value of it cannot be used.
        MotionFileError: a motion clip that cannot be used.
    """
    task_cfg: Any = OmegaConf.to_container(cfg.task, resolve=True)
    return find_task(str(task_cfg["name"]))(
        cfg=task_cfg,
        rl_device=rl_device,
        sim_device=sim_device,
        graphics_device_id=graphics_device_id,
        headless=headless,
        virtual_screen_capture=virtual_screen_capture,
        force_render=force_render,
    )


def seed_everything(seed: int, torch_deterministic: bool = False) -> None:
    """Seed Python, numpy and torch; with `torch_deterministic` forbid nondeterministic kernels."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    torch.cuda.manual_seed_all(seed)
    if torch_deterministic:
        torch.use_deterministic_algorithms(True)
        torch.backends.cudnn.benchmark = False
        torch.backends.cudnn.deterministic = True
