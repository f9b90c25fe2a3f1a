"""The actor and critic that the networks of this project's agents share."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from rl_games.algos_torch.network_builder import A2CBuilder
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.published_names import NETWORK_NAMES, PublishedNames


class ActorCriticNetwork(PublishedNames, A2CBuilder.Network):
    """rl_games' A2C network of MLPs, whose actor and critic can also be called separately."""

    replaced: ClassVar[dict[str, str]] = NETWORK_NAMES

    row_functions: tuple[str, ...] = ("eval_actor", "eval_critic")
    """Names of the methods that `ParallelNetwork` computes on several threads, some rows on
    each."""

    def __init__(self, params: dict[str, Any], **kwargs: Any) -> None:
        for section in ("rnn", "cnn"):
            if section in params:
                raise ConfigError(
                    f"train.params.network.{section}: networks of the AMP family are plain MLPs;"
                    " remove it"
                )
        super().__init__(params, **kwargs)
        if self.is_continuous and self.fixed_sigma:
            learn_sigma = params["space"]["continuous"].get("learn_sigma", False)
            self.sigma.requires_grad_(bool(learn_sigma))

    def forward(self, obs_dict: dict[str, Any]) -> tuple[Any, ...]:
        """Return mean actions, log standard deviations, values and no recurrent state.

        rl_games' forward pass is replaced, because it does not call `eval_actor` and `eval_critic`.
        """
        own, base = type(self), ActorCriticNetwork
        if own.eval_actor is base.eval_actor and own.eval_critic is base.eval_critic:
            return super().forward(obs_dict)
        obs = obs_dict["obs"]
        return *self.eval_actor(obs), self.eval_critic(obs), None

    def eval_actor(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions and log standard deviations (n, A) of normalised obs (n, O)."""
        return self._act_on(self.actor_mlp(obs))

    def _act_on(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions and log standard deviations, given the hidden layers' outputs."""
        mu = self.mu_act(self.mu(features))
        if self.fixed_sigma:
            return mu, torch.zeros_like(mu) + self.sigma_act(self.sigma)
        layer: Any = self.sigma
        return mu, self.sigma_act(layer(features))

    def eval_critic(self, obs: Tensor) -> Tensor:
        """Return normalised values (n, values) of normalised obs (n, O)."""
        trunk = self.critic_mlp if self.separate else self.actor_mlp
        return self.value_act(self.value(trunk(obs)))
