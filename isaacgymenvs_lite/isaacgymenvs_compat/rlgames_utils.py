"""The names of IsaacGymEnvs' `utils.rlgames_utils`."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypedDict

import gymnasium
import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor

from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.isaacgymenvs_compat.utils import set_seed
from isaacgymenvs_lite.run.metrics import TaskScalarsObserver as RLGPUAlgoObserver  # noqa: F401
from isaacgymenvs_lite.run.observers import MultiObserver  # noqa: F401  a published name
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv


def multi_gpu_get_rank(multi_gpu: bool) -> int:
    """Return this process' rank among torchrun's processes, or 0 without torchrun."""
    return int(os.environ.get("LOCAL_RANK", "0")) if multi_gpu else 0


def _with_or_without_seed(creator: Callable[..., Any]) -> Callable[..., Any]:
    """Allow calls without the argument `seed`, which IsaacGymEnvs' first releases lacked.

    Scripts for these releases call `set_seed` first; therefore torch's current seed is used.
    """

    @functools.wraps(creator)
    def called(*args: Any, **kwargs: Any) -> Any:
        if "seed" not in kwargs and not (args and isinstance(args[0], int)):
            args = (torch.initial_seed() % 2**32, *args)
        return creator(*args, **kwargs)

    return called


@_with_or_without_seed
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
        seed: seed of the first process.
        task_config: the section `task` of a composed tree, as dictionaries.
        task_name: name in the task map.
        sim_device: see `isaacgymenvs_lite.make`.
        rl_device: see `isaacgymenvs_lite.make`.
        graphics_device_id: see `isaacgymenvs_lite.make`.
        headless: see `isaacgymenvs_lite.make`.
        multi_gpu: whether each process gets another seed.
        post_create_hook: function that is called after a task was made.
        virtual_screen_capture: see `isaacgymenvs_lite.make`.
        force_render: see `isaacgymenvs_lite.make`.
    """

    def create_rlgpu_env(**kwargs: Any) -> VecTask:
        """Make the task; rl_games' keywords have no effect."""
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


class ObsSpec(TypedDict):
    """Describes an input of an agent.

    Attributes:
        names: names of the task's observations in the order of the input.
        concat: whether the input is one tensor (N, sum of D) instead of a dictionary.
        space_name: rl_games' name of the input's space, observation_space or state_space.
    """

    names: Sequence[str]
    concat: bool
    space_name: str


class ComplexObsRLGPUEnv(RLGPUEnv):
    """`RLGPUEnv` for networks with several inputs and tasks with several observations.

    `obs_spec` has the key `obs`, and the key `states` for an asymmetric critic. The task determines
    the number of environments.
    """

    def __init__(
        self, config_name: str, num_actors: int, obs_spec: Mapping[str, ObsSpec], **kwargs: Any
    ) -> None:
        super().__init__(config_name, num_actors, **kwargs)
        self.obs_spec = obs_spec

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """Advance by one control step; see `RLGPUEnv.step`."""
        obs, rewards, dones, infos = super().step(actions)
        return self._generate_obs(obs), rewards, dones, infos

    def reset(self) -> dict[str, Any]:
        """See `VecTask.reset`."""
        return self._generate_obs(super().reset())

    def reset_done(self) -> tuple[dict[str, Any], Tensor]:
        """See `VecTask.reset_done`."""
        obs, env_ids = super().reset_done()
        return self._generate_obs(obs), env_ids

    def get_env_info(self) -> dict[str, Any]:
        """Return the spaces of the action and of each input."""
        spaces = {
            spec["space_name"]: self.gen_obs_space(spec["names"], spec["concat"])
            for spec in self.obs_spec.values()
        }
        return {**super().get_env_info(), **spaces}

    def _generate_obs(self, env_obs: Mapping[str, Tensor]) -> dict[str, Any]:
        return {
            name: self.gen_obs_dict(env_obs, spec["names"], spec["concat"])
            for name, spec in self.obs_spec.items()
        }

    def gen_obs_dict(
        self, obs_dict: Mapping[str, Tensor], obs_names: Sequence[str], concat: bool
    ) -> Tensor | dict[str, Tensor]:
        """Return the observations (N, D) with the given names as one input."""
        chosen = {name: obs_dict[name] for name in obs_names}
        return torch.cat(list(chosen.values()), dim=1) if concat else chosen

    def gen_obs_space(self, obs_names: Sequence[str], concat: bool) -> gymnasium.Space:
        """Return the space of one input."""
        chosen: dict[str, Any] = {name: self._space_of(name) for name in obs_names}
        if not concat:
            return gymnasium.spaces.Dict(chosen)
        size = sum(space.shape[0] for space in chosen.values())
        return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def _space_of(self, name: str) -> gymnasium.spaces.Box:
        """Return the space (D,) of an observation, for example `obs` or `states`."""
        space: Any = self.env.observation_space
        if isinstance(space, gymnasium.spaces.Dict):
            return space[name]  # type: ignore[return-value]
        return self.env.state_space if name == "states" else space
