"""Measures what policies of a population are compared by."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import diverged_in
from isaacgymenvs_lite.errors import ConfigError

KEY = "true_objective"
"""Key of a task's infos: (N,), what matters in the end, whatever the reward is made of."""


class ObjectiveMeter:
    """The objective of the policy that trains, and the best that it reached since a comparison.

    With `infos["true_objective"]`: the mean over all environments of the value at the end of the
    last episode. Without: the mean reward of the last `games_to_track` episodes.

    Args:
        algo: the agent.
    """

    def __init__(self, algo: Any) -> None:
        self._algo = algo
        self._last: Tensor | None = None  # (N,) nan before the first end of an episode
        self._best = -math.inf

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Take the values of the environments (n, 1) whose episodes ended in a step.

        Raises:
            ConfigError: the task's objective is not one number for each environment.
        """
        rows = done_indices.flatten()
        if len(rows) == 0:
            return
        if KEY in infos:
            values = torch.as_tensor(infos[KEY])
            num_envs = self._algo.num_actors
            if values.shape != (num_envs,):
                raise ConfigError(
                    f"infos['{KEY}'] of the task has the shape {tuple(values.shape)}; population"
                    f" based training expects one number for each environment, ({num_envs},)"
                )
            if self._last is None:
                self._last = torch.full((num_envs,), math.nan, device=values.device)
            rows = rows.to(values.device)
            if (diverged := diverged_in(infos, values.device)) is not None:
                rows = rows[~diverged[rows]]  # cut off: no end of an episode
            self._last[rows] = values[rows].float()
        value = self.value
        if value is not None:
            self._best = max(self._best, value)

    @property
    def value(self) -> float | None:
        """The objective; None while episodes are missing."""
        if self._last is not None:
            mean = self._last.mean().item()
        elif self._algo.game_rewards.current_size >= self._algo.games_to_track:
            mean = float(self._algo.game_rewards.get_mean().flatten()[0])
        else:
            return None
        return mean if math.isfinite(mean) else None

    def end_interval(self, value: float) -> float:
        """Return the best value since the last call, including the present one, and forget it."""
        best, self._best = max(self._best, value), -math.inf
        return best
