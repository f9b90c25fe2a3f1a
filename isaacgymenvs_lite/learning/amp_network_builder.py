"""The AMP network: actor, critic and discriminator in one rl_games network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rl_games.algos_torch.network_builder import A2CBuilder
from torch import nn

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.modules.actor_critic_network import ActorCriticNetwork
from isaacgymenvs_lite.learning.modules.discriminator import (
    DISC_LOGIT_INIT_SCALE,
    DiscriminatorLayers,
)

__all__ = ["DEFAULT_INITIALIZER", "DISC_LOGIT_INIT_SCALE", "AMPBuilder"]

DEFAULT_INITIALIZER = {"name": "default"}


class AMPBuilder(A2CBuilder):
    """Builds the network of the section `network:` with `name: amp`.

    The parameters have the names in IsaacGymEnvs' checkpoints: `sigma, actor_mlp, critic_mlp,
    value, mu, _disc_mlp, _disc_logits`.
    """

    class Network(DiscriminatorLayers, ActorCriticNetwork):
        """Actor, critic and discriminator; AMP observations have the shape `amp_input_shape`."""

        row_functions = (*ActorCriticNetwork.row_functions, "eval_disc", "eval_disc_with_gradient")

        def __init__(self, params: dict[str, Any], **kwargs: Any) -> None:
            amp_input_shape = kwargs.pop("amp_input_shape")
            super().__init__(params, **kwargs)
            self._build_disc(amp_input_shape)

        def load(self, params: dict[str, Any]) -> None:
            """Read the section `network:` before the layers are built."""
            super().load(params)
            if "disc" not in params:
                raise ConfigError(
                    "train.params.network.disc is missing: expected units, activation and"
                    " initializer of the discriminator"
                )
            disc = params["disc"]
            self._disc_units = list(disc["units"])
            self._disc_activation = disc["activation"]
            self._disc_initializer = disc.get("initializer", DEFAULT_INITIALIZER)

        def _build_disc(self, input_shape: tuple[int, ...]) -> None:
            """Build the discriminator's layers for inputs (n, input_shape[0])."""
            units, activation = self._disc_units, self._disc_activation
            how = (units, activation, self._disc_initializer)
            self._set_disc_layers(self._hidden_layers("disc", input_shape[0], *how), units[-1])

        def _hidden_layers(
            self,
            section: str,
            inputs: int,
            units: Sequence[int],
            activation: str,
            initializer: dict[str, Any],
        ) -> nn.Module:
            """Return the initialised layers of a section, each with its activation."""
            if not units:
                raise ConfigError(
                    f"train.params.network.{section}.units=[]: expected at least one hidden layer"
                )
            layers = self._build_mlp(
                input_size=inputs, units=list(units), activation=activation, dense_func=nn.Linear
            )
            self._init_linear(layers, initializer)
            return layers

        def _init_linear(self, module: nn.Module, initializer: dict[str, Any]) -> None:
            """Initialise the weights of linear layers, and set biases to zero."""
            init = self.init_factory.create(**initializer)
            for layer in module.modules():
                if isinstance(layer, nn.Linear):
                    init(layer.weight)
                    nn.init.zeros_(layer.bias)

    def build(self, name: str, **kwargs: Any) -> AMPBuilder.Network:
        """Build the network."""
        return AMPBuilder.Network(self.params, **kwargs)
