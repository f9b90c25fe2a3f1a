"""The network of the high-level policy: an actor-critic with mean actions within +-1."""

from __future__ import annotations

from typing import Any

import torch
from rl_games.algos_torch.network_builder import A2CBuilder
from torch import Tensor

from isaacgymenvs_lite.learning.modules.actor_critic_network import ActorCriticNetwork


class HRLBuilder(A2CBuilder):
    """Builds the network of the section `network:` with `name: hrl`.

    Parameters have ASE's names: `sigma, actor_mlp, critic_mlp, value, mu`.
    """

    class Network(ActorCriticNetwork):
        """Actor and critic; the mean action is the tanh of the actor's output, like in ASE."""

        def _act_on(self, features: Tensor) -> tuple[Tensor, Tensor]:
            mu, logstd = super()._act_on(features)
            return torch.tanh(mu), logstd

        def forward(self, obs_dict: dict[str, Any]) -> tuple[Any, ...]:
            """Return mean actions, log standard deviations, values and no recurrent state."""
            obs = obs_dict["obs"]
            return *self.eval_actor(obs), self.eval_critic(obs), None

    def build(self, name: str, **kwargs: Any) -> HRLBuilder.Network:
        """Build the network."""
        return HRLBuilder.Network(self.params, **kwargs)
