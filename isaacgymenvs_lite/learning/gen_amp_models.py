"""The AMP model, which also returns the encoder's outputs."""

from __future__ import annotations

from typing import Any

from isaacgymenvs_lite.learning.amp_models import ModelAMPContinuous


class ModelGenAMPContinuous(ModelAMPContinuous):
    """`model: name: continuous_gen_amp`, `gen_amp` or `ase`.

    Every input has `obs` and `amp_latents` (n, Z). A training input with `amp_obs` (K, F) also has
    `amp_obs_latents` (K, Z), the policy's latents for `amp_obs`. The outputs then include
    `enc_pred` (K, Z), the inferred unit vectors. If the input `enc_gradient` is True, the output
    `enc_gradient` (K, F) is the gradient of the encoder's error with respect to `amp_obs`. A
    conditional discriminator also needs `amp_obs_replay_latents` and `amp_obs_demo_latents` (K, Z).
    """

    class Network(ModelAMPContinuous.Network):
        """The model as a torch module, whose `a2c_network` is the GenAMP network."""

        def forward(self, input_dict: dict[str, Any]) -> dict[str, Any]:
            """Act if `is_train` is False; otherwise evaluate a minibatch."""
            result = super().forward(input_dict)
            if not (input_dict.get("is_train", True) and "amp_obs_latents" in input_dict):
                return result
            amp_obs = input_dict["amp_obs"]
            if input_dict.get("enc_gradient", False):
                result["enc_pred"], result["enc_gradient"] = (
                    self.a2c_network.eval_enc_with_gradient(amp_obs, input_dict["amp_obs_latents"])
                )
            else:
                result["enc_pred"] = self.a2c_network.eval_enc(amp_obs)
            return result

        def _disc_inputs(self, input_dict: dict[str, Any], kind: str) -> tuple[Any, ...]:
            inputs = super()._disc_inputs(input_dict, kind)
            if not self.a2c_network.disc_is_conditional:
                return inputs
            return (*inputs, input_dict[f"{kind}_latents"])
