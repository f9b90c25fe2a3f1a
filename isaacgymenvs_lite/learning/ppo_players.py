"""rl_games' PPO player, for tasks that reset when they are asked to."""

from __future__ import annotations

import logging
from typing import Any

from rl_games.algos_torch.players import PpoPlayerContinuous
from torch import Tensor

from isaacgymenvs_lite.learning.common_player import DEFAULT_EPISODES
from isaacgymenvs_lite.learning.evaluation import EvaluationResult, evaluate

log = logging.getLogger(__name__)


class PPOPlayer(PpoPlayerContinuous):
    """The player of `a2c_continuous`.

    rl_games' play loop never asks for resets. Tasks that want that are played by the loop of our
    own players, with `games_num` episodes; all others by rl_games'.

    Attributes:
        result: what our loop measured; None before, and for the other tasks.
    """

    result: EvaluationResult | None = None

    def run(self) -> None:
        """Play, and log what was reached."""
        if not getattr(self.env, "resets_on_request", False):
            super().run()
            return
        games = int(self.player_config.get("games_num", DEFAULT_EPISODES))
        self.result = evaluate(self.env, self.act, games)
        log.info("played %s", self.result)

    def act(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the task's actions (N, A) for what the task observes."""
        self.has_batch_dimension = True
        rows: Any = self.obs_to_torch(obs)
        return self.get_action(rows, self.is_deterministic)
