"""rl_games' soft actor-critic, with checkpoints that a training can go on from."""

from __future__ import annotations

from typing import Any

import torch
from rl_games.algos_torch.players import SACPlayer as RLGamesSACPlayer
from rl_games.algos_torch.sac_agent import SACAgent as RLGamesSACAgent
from torch import Tensor, nn

from isaacgymenvs_lite.learning.episode_player import EpisodePlayer
from isaacgymenvs_lite.learning.precision import resolve_mixed_precision


class SACAgent(RLGamesSACAgent):
    """The agent of `algo: name: sac`: rl_games' loop, losses and replay buffer.

    Its checkpoints hold the temperature and the best reward, too, which rl_games' leave out: a
    resumed run would start again with `init_alpha`. The replay buffer is not stored (hundreds of
    MB): a resumed run acts by its policy until a batch is there, and learns then.

    `mixed_precision` on a CPU: the hidden layers compute in bfloat16, the outputs in float32, as
    values of some hundreds in bfloat16 are apart by more than what a step is paid. rl_games' own
    switch means CUDA autocast.

    Args:
        base_name: name for rl_games' bookkeeping.
        params: the section `params` of a train file, prepared by the Runner.

    Raises:
        ConfigError: mixed_precision is none of True, False, "auto".
    """

    def __init__(self, base_name: str, params: dict[str, Any]) -> None:
        config = params["config"]
        device = torch.device(config.get("device", "cuda:0"))
        on_cpu = device.type == "cpu"
        bfloat16 = resolve_mixed_precision(config.get("mixed_precision", False), device)
        config["mixed_precision"] = bfloat16 and not on_cpu
        # rl_games compiles a `forward` that SAC never calls.
        config.setdefault("torch_compile", False)
        # rl_games' other agents call it before they make their TensorBoard writer.
        name = config.get("full_experiment_name") or config["name"]
        config["features"]["observer"].before_init(base_name, config, name)
        super().__init__(base_name, params)
        nothing = torch.zeros((), device=self._device)
        no_loss = nothing if self.learnable_temperature else None
        self._last_of_actor = (nothing, nothing, self.alpha.detach(), no_loss)
        if bfloat16 and on_cpu:
            network = self.model.sac_network
            for critic in (network.critic, network.critic_target):
                compute_hidden_layers_in_bfloat16(critic.Q1)
                compute_hidden_layers_in_bfloat16(critic.Q2)
            compute_hidden_layers_in_bfloat16(network.actor.trunk)

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
        """Make a gradient step, once the replay buffer holds a batch.

        Returns:
            actor's loss, entropy, temperature and its loss; losses of both critics. Of a step that
            leaves the actor alone (`policy_frequency`), what the last one with the actor gave:
            rl_games gives zeros and None, which it cannot average with others.
        """
        buffer = self.replay_buffer
        if not buffer.full and buffer.idx < self.batch_size:
            nothing = torch.zeros((), device=self._device)
            return self._last_of_actor, nothing, nothing
        updates_actor = (self.update_counter + 1) % self.policy_frequency == 0
        of_actor, *of_critics = super().update(step)
        if updates_actor:
            self._last_of_actor = of_actor
        return self._last_of_actor, *of_critics


def compute_hidden_layers_in_bfloat16(network: nn.Sequential) -> None:
    """Let all layers but the last compute under autocast to bfloat16, on a CPU, in place.

    Parameters, their gradients and the outputs stay float32.
    """
    *hidden, last = network

    def forward(inputs: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            for layer in hidden:
                inputs = layer(inputs)
        return last(inputs.float())

    network.forward = forward  # type: ignore[method-assign]


class SACPlayer(EpisodePlayer, RLGamesSACPlayer):
    """The player of `sac`; see `EpisodePlayer`."""
