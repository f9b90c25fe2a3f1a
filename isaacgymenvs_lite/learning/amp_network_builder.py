"""The AMP network: actor, critic and discriminator in one rl_games network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from rl_games.algos_torch.network_builder import A2CBuilder
from torch import Tensor, nn

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.actor_critic_network import ActorCriticNetwork
from isaacgymenvs_lite.learning.losses import input_gradient

# The last layer of the discriminator starts in U(-1, 1), as IsaacGymEnvs and ASE.
_DISC_LOGIT_INIT_SCALE = 1.0


class AMPBuilder(A2CBuilder):
    """Builds the network of the section `network:` with `name: amp`.

    Parameter names are those of IsaacGymEnvs, so that its checkpoints load:
    `sigma, actor_mlp, critic_mlp, value, mu, _disc_mlp, _disc_logits`.
    """

    class Network(ActorCriticNetwork):
        """Actor and critic, and a discriminator beside them.

        Args:
            params: the section `network:`.
            kwargs: rl_games' build arguments and `amp_input_shape`, (F,).

        Raises:
            ConfigError: recurrent or convolutional networks, or no section `disc:`.
        """

        row_functions = (
            *ActorCriticNetwork.row_functions,
            "eval_disc",
            "eval_disc_with_gradient",
        )

        def __init__(self, params: dict[str, Any], **kwargs: Any) -> None:
            amp_input_shape = kwargs.pop("amp_input_shape")
            super().__init__(params, **kwargs)
            self._build_disc(params, amp_input_shape)

        def _build_disc(self, params: dict[str, Any], input_shape: tuple[int, ...]) -> None:
            if "disc" not in params:
                raise ConfigError(
                    "train.params.network.disc is missing: expected units, activation and"
                    " initializer of the discriminator"
                )
            disc = params["disc"]
            if len(disc["units"]) == 0:
                raise ConfigError(
                    "train.params.network.disc.units=[]: expected at least one hidden layer"
                )
            self._disc_mlp = self._hidden_layers(input_shape[0], disc["units"], disc)
            self._disc_logits = nn.Linear(disc["units"][-1], 1)
            nn.init.uniform_(
                self._disc_logits.weight, -_DISC_LOGIT_INIT_SCALE, _DISC_LOGIT_INIT_SCALE
            )
            nn.init.zeros_(self._disc_logits.bias)

        def _hidden_layers(
            self, inputs: int, units: Sequence[int], section: dict[str, Any]
        ) -> nn.Module:
            """Return layers with the section's activation behind each, initialised as it says."""
            layers = self._build_mlp(
                input_size=inputs,
                units=list(units),
                activation=section["activation"],
                dense_func=nn.Linear,
            )
            self._init_linear(layers, section)
            return layers

        def _init_linear(self, module: nn.Module, section: dict[str, Any]) -> None:
            """Initialise linear layers by a section's `initializer`, their biases with zeros."""
            init = self.init_factory.create(**section.get("initializer", {"name": "default"}))
            for layer in module.modules():
                if isinstance(layer, nn.Linear):
                    init(layer.weight)
                    nn.init.zeros_(layer.bias)

        def eval_disc(self, amp_obs: Tensor) -> Tensor:
            """Return discriminator logits (n, 1) for normalised AMP observations (n, F)."""
            return self._disc_logits(self._disc_mlp(amp_obs))

        def eval_disc_with_gradient(
            self, amp_obs: Tensor, *latents: Tensor
        ) -> tuple[Tensor, Tensor]:
            """Return logits (n, 1) and their gradients by the normalised AMP observations (n, F).

            The gradients can be differentiated by the parameters. Arguments as `eval_disc`.
            """
            with torch.enable_grad():
                amp_obs = amp_obs.detach().requires_grad_()
                logits = self.eval_disc(amp_obs, *latents)
            # The backward pass computes as the forward pass did; autocast has no say in it.
            with torch.autocast(amp_obs.device.type, enabled=False):
                return logits, input_gradient(logits, amp_obs)

        def disc_parameters(self) -> list[nn.Parameter]:
            """Return the parameters of the discriminator."""
            return [*self._disc_mlp.parameters(), *self._disc_logits.parameters()]

        def get_disc_logit_weights(self) -> Tensor:
            """Return the last layer's weights, flat."""
            return self._disc_logits.weight.flatten()

        def get_disc_weights(self) -> list[Tensor]:
            """Return all weight matrices of the discriminator, flat; no biases."""
            layers = [m for m in self._disc_mlp.modules() if isinstance(m, nn.Linear)]
            return [layer.weight.flatten() for layer in layers] + [self.get_disc_logit_weights()]

    def build(self, name: str, **kwargs: Any) -> AMPBuilder.Network:
        """Build the network; rl_games calls this through the model."""
        del name
        return AMPBuilder.Network(self.params, **kwargs)
