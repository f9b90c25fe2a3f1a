"""rl_games' PPO player, with the play loop of our own players."""

from __future__ import annotations

from typing import Any

from rl_games.algos_torch.players import PpoPlayerContinuous
from torch import Tensor

from isaacgymenvs_lite.learning.evaluation import (
    EvaluationResult,
    episodes_to_play,
    evaluate_and_log,
)


class PPOPlayer(PpoPlayerContinuous):
    """The player of `a2c_continuous`: `games_num` episodes in a loop that ends without a window.

    Attributes:
        result: what was measured; None before.
    """

    result: EvaluationResult | None = None

    def __init__(self, params: dict[str, Any]) -> None:
        super().__init__(params)
        self.has_batch_dimension = True
        self.batch_size = self.env.num_envs * self.num_agents
        self.init_rnn()

    def run(self) -> None:
        """Play, and log what was reached."""
        games = episodes_to_play(self.player_config)
        self.result = evaluate_and_log(self.env, self.act, games, on_step=self.on_step)

    def act(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the task's actions (N, A) for what the task observes."""
        rows: Any = self.obs_to_torch(obs)
        return self.get_action(rows, self.is_deterministic)

    def on_step(self, dones: Tensor, infos: dict[str, Any]) -> None:
        """Let a recurrent policy begin anew where episodes ended, dones (N,)."""
        del infos
        if self.is_rnn:
            ended = dones.nonzero().flatten()
            for state in self.states:  # (layers, N, units)
                state[:, ended] = 0.0
