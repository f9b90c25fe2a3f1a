"""rl_games' Gaussian policy model with discriminator outputs."""

from __future__ import annotations

from typing import Any

import torch
from rl_games.algos_torch.models import BaseModel, ModelA2CContinuousLogStd


class ModelAMPContinuous(ModelA2CContinuousLogStd):
    """`model: name: continuous_amp`; normalisers of observations and values live inside it.

    With `amp_obs`, `amp_obs_replay` and `amp_obs_demo` (normalised, (K, F) each) in a training
    input, the output has `disc_agent_logit`, `disc_agent_replay_logit` and `disc_demo_logit`
    (K, 1), and `disc_demo_gradient` (K, F), beside the outputs of `ModelA2CContinuousLogStd`.
    `amp_obs_noise` and so on (K, F), if they are given, are added to the discriminator's inputs.
    """

    def __init__(self, network: Any) -> None:
        BaseModel.__init__(self, "amp")
        self.network_builder = network

    class Network(ModelA2CContinuousLogStd.Network):
        """The model's module; `a2c_network` is the AMP network."""

        def forward(self, input_dict: dict[str, Any]) -> dict[str, Any]:
            """Act (`is_train` False) or evaluate a minibatch; see the class docstring."""
            result = super().forward(input_dict)
            if input_dict.get("is_train", True) and "amp_obs" in input_dict:
                result |= self._eval_discriminator(input_dict)
            return result

        def _eval_discriminator(self, input_dict: dict[str, Any]) -> dict[str, Any]:
            agent = self._disc_inputs(input_dict, "amp_obs")
            replay = self._disc_inputs(input_dict, "amp_obs_replay")
            fakes = [torch.cat(pair) for pair in zip(agent, replay, strict=True)]
            agent_logit, replay_logit = self.a2c_network.eval_disc(*fakes).split(len(agent[0]))
            demo = self._disc_inputs(input_dict, "amp_obs_demo")
            demo_logit, gradient = self.a2c_network.eval_disc_with_gradient(*demo)
            return {
                "disc_agent_logit": agent_logit,
                "disc_agent_replay_logit": replay_logit,
                "disc_demo_logit": demo_logit,
                "disc_demo_gradient": gradient,
            }

        def _disc_inputs(self, input_dict: dict[str, Any], kind: str) -> tuple[Any, ...]:
            """Return the discriminator's inputs for the rows of a kind."""
            rows, noise = input_dict[kind], input_dict.get(f"{kind}_noise")
            return (rows if noise is None else rows + noise,)
