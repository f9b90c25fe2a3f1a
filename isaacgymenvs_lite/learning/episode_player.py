"""EpisodePlayer: rl_games' own players, with the play loop of ours."""

from __future__ import annotations

from typing import Any

import torch
from rl_games.common.player import BasePlayer
from torch import Tensor

from isaacgymenvs_lite.evaluation.evaluate import (
    EvaluationResult,
    episodes_to_play,
    evaluate_and_log,
    play_on,
)


class EpisodePlayer(BasePlayer):
    """Plays `games_num` episodes in a loop that ends without a window; stands before the player.

    Attributes:
        result: what was measured; None before.
    """

    result: EvaluationResult | None = None

    def __init__(self, params: dict[str, Any]) -> None:
        super().__init__(params)
        self.has_batch_dimension = True

    def run(self) -> None:
        """Play, log what was reached, and play on for whoever looks on."""
        games = episodes_to_play(self.player_config)
        self.result = evaluate_and_log(self.env, self.act, games, on_step=self.on_step)
        play_on(self.env, self.act, self.on_step)

    def act(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the task's actions (N, A) for what the task observes."""
        rows: Any = self.obs_to_torch(obs)
        with torch.no_grad():
            return self.get_action(rows, self.is_deterministic)

    def on_step(self, dones: Tensor, infos: dict[str, Any]) -> None:
        """Hear the dones (N,) and infos of each step, before resets."""
        del dones, infos
