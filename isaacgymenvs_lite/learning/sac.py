"""rl_games' soft actor-critic, with checkpoints that a training can go on from."""

from __future__ import annotations

from typing import Any

import torch
from rl_games.algos_torch.players import SACPlayer as RLGamesSACPlayer
from rl_games.algos_torch.sac_agent import SACAgent as RLGamesSACAgent

from isaacgymenvs_lite.learning.episode_player import EpisodePlayer


class SACAgent(RLGamesSACAgent):
    """The agent of `algo: name: sac`: rl_games' loop, losses and replay buffer.

    Its checkpoints hold the temperature and the best reward, too, which rl_games' leave out: a
    resumed run would start again with `init_alpha`. The replay buffer is not stored (hundreds of
    MB): a resumed run acts by its policy until a batch is there, and learns then.

    Args:
        base_name: name for rl_games' bookkeeping.
        params: the section `params` of a train file, prepared by the Runner.
    """

    def __init__(self, base_name: str, params: dict[str, Any]) -> None:
        # rl_games' other agents call it before they make their TensorBoard writer.
        config = params["config"]
        name = config.get("full_experiment_name") or config["name"]
        config["features"]["observer"].before_init(base_name, config, name)
        super().__init__(base_name, params)

    @property
    def curr_frames(self) -> int:
        """Environment steps of an epoch, under the name that rl_games' other agents have for it."""
        return self.num_frames_per_epoch

    def get_full_state_weights(self) -> dict[str, Any]:
        """Return what goes into a checkpoint."""
        return {
            **super().get_full_state_weights(),
            "log_alpha": self.log_alpha.detach(),
            "last_mean_rewards": self.last_mean_rewards,
            "env_state": self.vec_env.get_env_state(),
        }

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Take back what `get_full_state_weights` gave; rl_games' files lack the temperature."""
        super().set_full_state_weights(weights, set_epoch=set_epoch)
        if "log_alpha" in weights:
            with torch.no_grad():
                self.log_alpha.copy_(weights["log_alpha"])

    def update(self, step: int) -> Any:
        """Make a gradient step, once the replay buffer holds a batch."""
        buffer = self.replay_buffer
        if not buffer.full and buffer.idx < self.batch_size:
            nothing = torch.zeros((), device=self._device)
            return (nothing, nothing, self.alpha.detach(), None), nothing, nothing
        return super().update(step)


class SACPlayer(EpisodePlayer, RLGamesSACPlayer):
    """The player of `sac`; see `EpisodePlayer`."""
