"""The names of IsaacGymEnvs' `utils.rlgames_utils`."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from omegaconf import OmegaConf

from isaacgymenvs_lite.making import make_from_config
from isaacgymenvs_lite.observers import MultiObserver
from isaacgymenvs_lite.observers import TaskScalarsObserver as RLGPUAlgoObserver
from isaacgymenvs_lite.published.utils import set_seed
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv

__all__ = [
    "MultiObserver",
    "RLGPUAlgoObserver",
    "RLGPUEnv",
    "get_rlgames_env_creator",
    "multi_gpu_get_rank",
]


def multi_gpu_get_rank(multi_gpu: bool) -> int:
    """Return the rank of this process among those of torchrun; 0 without them."""
    return int(os.environ.get("LOCAL_RANK", "0")) if multi_gpu else 0


def get_rlgames_env_creator(
    seed: int,
    task_config: dict[str, Any],
    task_name: str,
    sim_device: str,
    rl_device: str,
    graphics_device_id: int,
    headless: bool,
    multi_gpu: bool = False,
    post_create_hook: Callable[[], None] | None = None,
    virtual_screen_capture: bool = False,
    force_render: bool = False,
) -> Callable[..., VecTask]:
    """Return a function that makes a task, for rl_games' `env_configurations.register`.

    Args:
        seed: of the first process.
        task_config: the section `task` of a composed tree, as dictionaries.
        task_name: in the task map.
        sim_device: where the physics runs.
        rl_device: where `step` returns its tensors.
        graphics_device_id: of the renderer.
        headless: without a window.
        multi_gpu: seed each process of its own.
        post_create_hook: called after a task was made.
        virtual_screen_capture: as `make`.
        force_render: as `make`.
    """

    def create_rlgpu_env(**kwargs: Any) -> VecTask:
        """Make the task; rl_games' keywords have no effect."""
        del kwargs
        set_seed(seed, rank=multi_gpu_get_rank(multi_gpu))
        env = make_from_config(
            OmegaConf.create({"task": {**task_config, "name": task_name}}),
            rl_device=rl_device,
            sim_device=sim_device,
            graphics_device_id=graphics_device_id,
            headless=headless,
            virtual_screen_capture=virtual_screen_capture,
            force_render=force_render,
        )
        if post_create_hook is not None:
            post_create_hook()
        return env

    return create_rlgpu_env
