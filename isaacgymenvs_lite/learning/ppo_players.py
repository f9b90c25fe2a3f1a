"""rl_games' PPO player, with the play loop of our own players."""

from __future__ import annotations

from typing import Any

from rl_games.algos_torch.players import PpoPlayerContinuous
from torch import Tensor

from isaacgymenvs_lite.learning.episode_player import EpisodePlayer
from isaacgymenvs_lite.learning.restoring import RestoringPlayer


class PPOPlayer(EpisodePlayer, RestoringPlayer, PpoPlayerContinuous):
    """The player of `a2c_continuous`, of recurrent policies too; see `EpisodePlayer`."""

    def __init__(self, params: dict[str, Any]) -> None:
        super().__init__(params)
        self.batch_size = self.env.num_envs * self.num_agents
        self.init_rnn()

    def on_step(self, dones: Tensor, infos: dict[str, Any]) -> None:
        """Let a recurrent policy begin anew where episodes ended, dones (N,)."""
        del infos
        if self.is_rnn:
            ended = dones.nonzero().flatten()
            for state in self.states:  # (layers, N, units)
                state[:, ended] = 0.0
