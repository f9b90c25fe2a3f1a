"""Returns and lengths of ended episodes."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class EndedEpisodes:
    """The n episodes that ended with a step.

    Attributes:
        env_ids: (n,) int64, their environments.
        returns: (n,) float64 sums of rewards.
        lengths: (n,) int64 control steps.
        time_s: since the start of the statistics.
    """

    env_ids: Tensor
    returns: Tensor
    lengths: Tensor
    time_s: float


class EpisodeStatistics:
    """Counts rewards and steps of the episodes of N environments.

    Args:
        num_envs: N.
        device: of the rewards.
    """

    def __init__(self, num_envs: int, device: str | torch.device) -> None:
        # In float64: a thousand float32 rewards would lose digits.
        self._returns = torch.zeros(num_envs, dtype=torch.float64, device=device)
        self._lengths = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._start_s = time.perf_counter()

    def restart(self, mask: Tensor) -> None:
        """Start new counts where `mask` (N,) bool is True."""
        self._returns.masked_fill_(mask, 0.0)
        self._lengths.masked_fill_(mask, 0)

    def count(self, rewards: Tensor, ended: Tensor) -> EndedEpisodes:
        """Count a step with rewards (N,); return the episodes that ended, `ended` (N,) bool."""
        self._returns += rewards
        self._lengths += 1
        env_ids = ended.nonzero().flatten()
        episodes = EndedEpisodes(
            env_ids,
            self._returns[env_ids],
            self._lengths[env_ids],
            time.perf_counter() - self._start_s,
        )
        self.restart(ended)
        return episodes
