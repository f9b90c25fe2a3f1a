# pyright: reportMissingImports=false
"""A task as an environment of skrl: torch in and out."""

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

    `infos` holds the task's infos for each environment at the end of the step, `amp_obs` (N, F) for
    example, and in `episode` the infos for all environments together, which trainers log. Steps
    that end episodes add `final_observations` (N, F): the last ones of the ended episodes, where
    `step` returns the first ones of the next. Rows of other environments mean nothing.

    `render_mode` is `rgb_array` or None; `stepper` steps the task.
    """

    def __init__(self, task: Any, render_mode: str | None = None) -> None:
        self.stepper = AutoresetTask(task, type(self).__name__, render_mode=render_mode)
        self.task = self.stepper.task
        self._states: Tensor | None = None
        super().__init__(self.task)

    def reset(self) -> tuple[Tensor, dict[str, Any]]:
        """Start new episodes and return their observations (N, F) and no infos."""
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
        # Copies, because agents add to the rewards in place.
        columns = (step.rewards, step.terminated, step.truncated)
        rewards, terminated, truncated = (column.clone().unsqueeze(-1) for column in columns)
        return self._observed(step.observations), rewards, terminated, truncated, infos

    def state(self) -> Tensor | None:
        """Return the states (N, S) of asymmetric critics; None if the task has none."""
        return self._states

    def render(self, *args: Any, **kwargs: Any) -> list[Image] | None:
        """Return a picture of each environment; None without a render mode."""
        return self.stepper.render()

    def close(self) -> None:
        """Free renderer and simulation."""
        self.stepper.close()

    def _observed(self, observations: Observations) -> Tensor:
        self._states = observations.get("states")
        return observations["obs"]

    @property
    def device(self) -> torch.device:
        """Where observations are and actions are expected."""
        return torch.device(self.task.rl_device)

    @property
    def state_space(self) -> gymnasium.Space | None:
        """Box of one environment's states; None if the task has none."""
        return self.task.state_space if self.task.num_states > 0 else None
