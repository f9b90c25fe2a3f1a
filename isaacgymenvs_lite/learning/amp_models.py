"""rl_games' Gaussian policy model with discriminator outputs."""

from __future__ import annotations

from typing import Any

from rl_games.algos_torch.models import BaseModel, ModelA2CContinuousLogStd

from isaacgymenvs_lite.learning.modules.discriminator import eval_discriminator


class ModelAMPContinuous(ModelA2CContinuousLogStd):
    """`model: name: continuous_amp`, with the normalisers of observations and values inside.

    A training input with `amp_obs`, `amp_obs_replay` and `amp_obs_demo` (normalised, (K, F) each)
    also returns the values of `eval_discriminator`. `amp_obs_noise`, `amp_obs_replay_noise` and
    `amp_obs_demo_noise` (K, F) are added to these inputs if they are given.
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
                kinds = ("amp_obs", "amp_obs_replay", "amp_obs_demo")
                inputs = (self._disc_inputs(input_dict, kind) for kind in kinds)
                result |= eval_discriminator(self.a2c_network, *inputs)
            return result

        def _disc_inputs(self, input_dict: dict[str, Any], kind: str) -> tuple[Any, ...]:
            """Return the arguments of `eval_disc` for the rows named `kind`."""
            rows, noise = input_dict[kind], input_dict.get(f"{kind}_noise")
            return (rows if noise is None else rows + noise,)
