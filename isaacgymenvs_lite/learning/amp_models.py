"""rl_games' Gaussian policy model, which also returns discriminator logits."""

from __future__ import annotations

from typing import Any

from rl_games.algos_torch.models import BaseModel, ModelA2CContinuousLogStd

from isaacgymenvs_lite.learning.modules.discriminator import eval_discriminator


class ModelAMPContinuous(ModelA2CContinuousLogStd):
    """`model: name: continuous_amp`; it contains the normalisers of observations and values.

    If a training input has `amp_obs`, `amp_obs_replay` and `amp_obs_demo` (normalised, (K, F)
    each), the outputs include the values of `eval_discriminator`. If `amp_obs_noise`,
    `amp_obs_replay_noise` and `amp_obs_demo_noise` (K, F) are given, they are added to the AMP
    observations.
    """

    def __init__(self, network: Any) -> None:
        BaseModel.__init__(self, "amp")
        self.network_builder = network

    class Network(ModelA2CContinuousLogStd.Network):
        """The model as a torch module, whose `a2c_network` is the AMP network."""

        def forward(self, input_dict: dict[str, Any]) -> dict[str, Any]:
            """Act if `is_train` is False; otherwise evaluate a minibatch."""
            result = super().forward(input_dict)
            if input_dict.get("is_train", True) and "amp_obs" in input_dict:
                kinds = ("amp_obs", "amp_obs_replay", "amp_obs_demo")
                inputs = (self._disc_inputs(input_dict, kind) for kind in kinds)
                result |= eval_discriminator(self.a2c_network, *inputs)
            return result

        def _disc_inputs(self, input_dict: dict[str, Any], kind: str) -> tuple[Any, ...]:
            """Return the arguments of `eval_disc` for the AMP observations with the key `kind`."""
            rows, noise = input_dict[kind], input_dict.get(f"{kind}_noise")
            return (rows if noise is None else rows + noise,)
