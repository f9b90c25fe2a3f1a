# pyright: reportMissingImports=false
"""Wraps a task as an environment of skrl, with torch tensors."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from skrl.envs.wrappers.torch import Wrapper
from torch import Tensor

from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask, Observations


class SkrlVecEnvWrapper(Wrapper):
    """N environments of a task of `isaacgymenvs_lite.make` for skrl's trainers and agents.

    `infos` has the task's infos for each environment at the end of the step, for example `amp_obs`
    (N, F); `infos["episode"]` has the infos about all environments, which trainers log. A step that
    ends episodes returns the first observations of the next episodes, and its infos have the key
    `final_observations` (N, F). Row i is the last observation of environment i's ended episode; it
    has no meaning if no episode of environment i ended.

    `render_mode` is `rgb_array` or None; `stepper` steps the task.
    """

    def __init__(self, task: Any, render_mode: str | None = None) -> None:
        self.stepper = AutoresetTask(task, type(self).__name__, render_mode=render_mode)
        self.task = self.stepper.task
        self._states: Tensor | None = None
        super().__init__(self.task)

    def reset(self) -> tuple[Tensor, dict[str, Any]]:
        """Start new episodes; return their observations (N, F) and empty infos."""
        return self._observed(self.stepper.reset()), {}

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advance by one control step with actions (N, A).

        Returns:
            observations (N, F), rewards (N, 1), terminated (N, 1), truncated (N, 1) and infos.
        """
        step = self.stepper.step(actions)
        infos: dict[str, Any] = dict(step.per_env)
        if step.scalars:
            infos["episode"] = {
                name.removeprefix("episode/"): torch.tensor(value)
                for name, value in step.scalars.items()
            }
        if step.final_observations is not None:
            infos["final_observations"] = step.final_observations["obs"]
        # Agents change the rewards in place, so that they must receive copies.
        columns = (step.rewards, step.terminated, step.truncated)
        rewards, terminated, truncated = (column.clone().unsqueeze(-1) for column in columns)
        return self._observed(step.observations), rewards, terminated, truncated, infos

    def state(self) -> Tensor | None:
        """Return the states (N, S) of asymmetric critics, or None if the task has no states."""
        return self._states

    def render(self, *args: Any, **kwargs: Any) -> list[Image] | None:
        """Return a picture of each environment, or None without a render mode."""
        return self.stepper.render()

    def close(self) -> None:
        """Release the renderer and the simulation."""
        self.stepper.close()

    def _observed(self, observations: Observations) -> Tensor:
        self._states = observations.get("states")
        return observations["obs"]

    @property
    def device(self) -> torch.device:
        """Device of observations and actions."""
        return torch.device(self.task.rl_device)

    @property
    def state_space(self) -> gymnasium.Space | None:
        """Box of one environment's states, or None if the task has no states."""
        return self.task.state_space if self.task.num_states > 0 else None
