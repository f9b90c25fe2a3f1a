"""Makes environments like Isaac Lab's: `gymnasium.make("Isaac-Cartpole-v0", cfg=cfg)`."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from gymnasium.vector.utils import batch_space
from omegaconf import DictConfig
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.wrappers.autoreset import RENDER_MODE, AutoresetTask, Observations
from isaacgymenvs_lite.wrappers.gymnasium_env import ShowsFirst, make_task


def make_isaac_lab_env(
    task: str,
    cfg: DictConfig | None = None,
    render_mode: str | None = None,
    num_envs: int | str = "",
    **keys: Any,
) -> IsaacLabEnv:
    """Make the environment of `gymnasium.make("Isaac-Cartpole-v0", ...)`.

    Args:
        task: name of a task file.
        cfg: a tree of `isaacgymenvs_lite.config.compose.compose_task`, which replaces all `keys`.
        render_mode: `rgb_array` or None.
        num_envs: number of environments N; '' selects the number in the task file.
        keys: keys of cfg/config.yaml such as `seed=1`.

    Raises:
        ConfigError: `cfg` is not a tree of this project, a key is unknown, or a value is wrong.
    """
    if cfg is not None and not (isinstance(cfg, DictConfig) and "task" in cfg):
        raise ConfigError(
            f"gymnasium.make: cfg={type(cfg).__name__}: expected a tree of"
            f' isaacgymenvs_lite.config.compose.compose_task("{task}", ["num_envs=64"]); Isaac'
            " Lab's own configurations describe its simulator"
        )
    made, random = make_task(task, num_envs, keys, cfg=cfg)
    return IsaacLabEnv(AutoresetTask(made, IsaacLabEnv.__name__, random, render_mode), cfg)


class IsaacLabEnv(ShowsFirst, gymnasium.Env[dict[str, Tensor], Tensor]):
    """N environments of a task in one object with batches of tensors, as in Isaac Lab.

    A step that ends an episode returns the first observation of the next episode. Observations are
    {"policy": (N, F)}; for an asymmetric critic they also have the key `critic` with (N, S).
    `step_dt` is the control step in s; `max_episode_length` counts control steps.
    """

    metadata: dict[str, Any] = {"render_modes": [None, RENDER_MODE]}  # noqa: RUF012

    def __init__(self, stepper: AutoresetTask, cfg: DictConfig | None) -> None:
        self.stepper, self.task, self.cfg = stepper, stepper.task, cfg
        self.num_envs, self.device = self.task.num_envs, torch.device(self.task.rl_device)
        self.step_dt = self.task.simulation.dt
        self.max_episode_length = self.task.max_episode_length
        self.render_mode = stepper.render_mode
        self.metadata = {**self.metadata, "render_fps": stepper.render_fps}
        spaces = {"policy": self.task.observation_space}
        if self.task.num_states > 0:
            spaces["critic"] = self.task.state_space
        self.single_observation_space = gymnasium.spaces.Dict(spaces)
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Start new episodes in all environments; `options` have no effect."""
        super().reset(seed=seed)
        return _renamed(self.stepper.reset(seed)), {}

    def step(self, action: Any) -> tuple[dict[str, Tensor], Any, Any, Any, dict[str, Any]]:
        """Advance by one control step with actions (N, A).

        Returns:
            observations, rewards (N,), terminated (N,), truncated (N,), and infos. Each info has a
            row for each environment, except `log`, which has values for all environments.
        """
        step = self.stepper.step(torch.as_tensor(action, dtype=torch.float32))
        infos = {**step.per_env, "log": step.scalars}
        return _renamed(step.observations), step.rewards, step.terminated, step.truncated, infos


def _renamed(observations: Observations) -> dict[str, Tensor]:
    names = {"obs": "policy", "states": "critic"}
    return {names.get(name, name): rows for name, rows in observations.items()}
