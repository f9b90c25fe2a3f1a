"""The GenAMP network: the AMP network with skill latents and an encoder.

Peng et al. 2022, "ASE: Large-Scale Reusable Adversarial Skill Embeddings" (arXiv 2205.01906).
The parameters have the names in ASE's checkpoints, which can be loaded.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_network_builder import DEFAULT_INITIALIZER, AMPBuilder
from isaacgymenvs_lite.learning.modules.discriminator import input_gradient
from isaacgymenvs_lite.learning.published_names import NETWORK_NAMES, PublishedNames
from isaacgymenvs_lite.learning.skills.latents import sample_latents

_STYLE_UNITS = (512, 256)
# The initial weights spread styles over tanh's range, and the encoder's outputs around one point of
# the sphere (as in ASE).
_STYLE_INIT_SCALE = 1.0
ENC_LOGIT_INIT_SCALE = 0.1


class StyleMLP(PublishedNames, nn.Module):
    """The actor's hidden layers; their input is the observation and a style (an encoded latent).

    style(z) = tanh(W MLP(z)) has the latent's dimension; `style_units` are the layer sizes of MLP.
    """

    replaced: ClassVar[dict[str, str]] = NETWORK_NAMES

    def __init__(
        self,
        obs_size: int,
        latent_dim: int,
        units: Sequence[int],
        style_units: Sequence[int],
        style_layers: nn.Module,
        activation: nn.Module,
    ) -> None:
        super().__init__()
        self._style_mlp = style_layers
        self._style_dense = nn.Linear(style_units[-1], latent_dim)
        sizes = [obs_size + latent_dim, *units]
        self._dense_layers = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(sizes))
        self._activation = activation

    def eval_style(self, latents: Tensor) -> Tensor:
        """Return styles (n, latent_dim) of latents (n, latent_dim)."""
        return torch.tanh(self._style_dense(self._style_mlp(latents)))

    def forward(self, obs: Tensor, latents: Tensor, use_hidden_latents: bool = False) -> Tensor:
        """Return the outputs (n, units[-1]); if `use_hidden_latents`, `latents` are styles."""
        style = latents if use_hidden_latents else self.eval_style(latents)
        features = torch.cat((obs, style), dim=-1)
        for layer in self._dense_layers:
            features = self._activation(layer(features))
        return features


class LatentMLP(PublishedNames, nn.Module):
    """The critic's hidden layers; their input is the observation and the latent."""

    replaced: ClassVar[dict[str, str]] = NETWORK_NAMES

    def __init__(self, layers: nn.Module) -> None:
        super().__init__()
        self._mlp = layers

    def forward(self, obs: Tensor, latents: Tensor) -> Tensor:
        """Return the outputs (n, units[-1])."""
        return self._mlp(torch.cat((obs, latents), dim=-1))


class GenAMPBuilder(AMPBuilder):
    """Builds the network of the section `network:` with `name: gen_amp` or `ase`.

    The network has AMPBuilder's parameters, and `actor_mlp._style_mlp, ._style_dense,
    ._dense_layers`, `critic_mlp._mlp`, `_enc_mlp` and `_enc`.
    """

    class Network(AMPBuilder.Network):
        """Actor, critic, discriminator and encoder.

        Args:
            params: the section `network:`. If `enc.separate` is False, the encoder shares the
                discriminator's layers and `enc.units` is ignored. Three keys are new here.
                `style.units` are the sizes of the layers that encode the latent (default: ASE's
                [512, 256]). `latent_scale` is the length to which networks scale their latents
                (default 1). If `disc.conditional` is True, the latent is an input of the
                discriminator, which then judges whether the motion fits the latent (CALM, Tessler
                et al. 2023, arXiv 2305.02195, section 4.2).
            kwargs: AMPBuilder's arguments, and `amp_latent_shape` (or ASE's `ase_latent_shape`),
                which is (Z,).

        Attributes:
            disc_is_conditional: whether `eval_disc` needs latents.
        """

        row_functions = (*AMPBuilder.Network.row_functions, "eval_enc", "eval_enc_with_gradient")

        def __init__(self, params: dict[str, Any], **kwargs: Any) -> None:
            names = ("amp_latent_shape", "ase_latent_shape")
            latent_shape = next(kwargs.pop(name) for name in names if name in kwargs)
            (obs_size,), (amp_obs_size,) = kwargs["input_shape"], kwargs["amp_input_shape"]
            if not params.get("separate", False):
                raise ConfigError(
                    "train.params.network.separate=False: actor and critic share layers, but only"
                    " the actor encodes the latent as a style; set it to True"
                )
            # The attributes are set before the base class' constructor, which builds the
            # discriminator from them.
            self._latent_dim = int(latent_shape[0])
            self._latent_scale = float(params.get("latent_scale", 1.0))
            super().__init__(params, **kwargs)
            self._build_trunks(params, obs_size)
            self._build_enc((amp_obs_size,))

        @property
        def _ase_latent_shape(self) -> tuple[int]:
            return (self._latent_dim,)

        def load(self, params: dict[str, Any]) -> None:
            """Read the section `network:` before the layers are built."""
            super().load(params)
            if "enc" not in params:
                raise ConfigError(
                    "train.params.network.enc is missing: expected units, activation, separate and"
                    " initializer of the encoder"
                )
            enc = params["enc"]
            self._enc_separate = bool(enc.get("separate", False))
            # The keys of the section `enc` are only used for a separate encoder.
            self._enc_units = list(enc["units"] if self._enc_separate else enc.get("units") or ())
            self._enc_activation = enc["activation"] if self._enc_separate else ""
            self._enc_initializer = enc.get("initializer", DEFAULT_INITIALIZER)
            self.disc_is_conditional = bool(params["disc"].get("conditional", False))

        def _build_trunks(self, params: dict[str, Any], obs_size: int) -> None:
            """Replace the hidden layers of actor and critic by layers with latents as inputs."""
            mlp = params["mlp"]
            how = (mlp["activation"], mlp.get("initializer", DEFAULT_INITIALIZER))
            style_units = list(params.get("style", {}).get("units", _STYLE_UNITS))

            self.actor_mlp = StyleMLP(
                obs_size,
                self._latent_dim,
                mlp["units"],
                style_units,
                self._hidden_layers("style", self._latent_dim, style_units, *how),
                self.activations_factory.create(mlp["activation"]),
            )
            self._init_linear(self.actor_mlp, how[1])
            self.critic_mlp = LatentMLP(
                self._hidden_layers("mlp", obs_size + self._latent_dim, mlp["units"], *how)
            )
            style_dense = self.actor_mlp._style_dense
            nn.init.uniform_(style_dense.weight, -_STYLE_INIT_SCALE, _STYLE_INIT_SCALE)

        def _build_disc(self, input_shape: tuple[int, ...]) -> None:
            if not self.disc_is_conditional:
                super()._build_disc(input_shape)
                return
            if not self._enc_separate:
                raise ConfigError(
                    "train.params.network.disc.conditional=True: the encoder must not share layers"
                    " with a discriminator that receives the latent; set enc.separate=True"
                )
            super()._build_disc((input_shape[0] + self._latent_dim,))

        def _build_enc(self, input_shape: tuple[int, ...]) -> None:
            """Build the encoder's layers for inputs (n, input_shape[0])."""
            if self._enc_separate:
                how = (self._enc_units, self._enc_activation, self._enc_initializer)
                self._enc_mlp = self._hidden_layers("enc", input_shape[0], *how)
                width = self._enc_units[-1]
            else:
                self._enc_mlp = self._disc_mlp
                width = self._disc_logits.in_features
            self._enc = nn.Linear(width, self._latent_dim)
            nn.init.uniform_(self._enc.weight, -ENC_LOGIT_INIT_SCALE, ENC_LOGIT_INIT_SCALE)
            nn.init.zeros_(self._enc.bias)

        def forward(self, obs_dict: dict[str, Any]) -> tuple[Any, ...]:
            """Return mean actions, log standard deviations, values and no recurrent state."""
            obs, latents = obs_dict["obs"], obs_dict["amp_latents"]
            mu, logstd = self.eval_actor(obs, latents)
            return mu, logstd, self.eval_critic(obs, latents), None

        def eval_actor(
            self,
            obs: Tensor,
            amp_latents: Tensor | None = None,
            use_hidden_latents: bool = False,
            *,
            ase_latents: Tensor | None = None,
        ) -> tuple[Tensor, Tensor]:
            """Return mean actions and log standard deviations (n, A).

            `obs` (n, O) are normalised. The latents (n, Z) are unit vectors, or styles if
            `use_hidden_latents` is True; `ase_latents` is ASE's name of this argument.
            """
            latents = _one_of(amp_latents, ase_latents)
            if not use_hidden_latents:
                latents = self._latent_scale * latents
            return self._act_on(self.actor_mlp(obs, latents, use_hidden_latents))

        def eval_critic(
            self,
            obs: Tensor,
            amp_latents: Tensor | None = None,
            use_hidden_latents: bool = False,
            *,
            ase_latents: Tensor | None = None,
        ) -> Tensor:
            """Return normalised values (n, values); like in ASE, the critic does not use styles."""
            del use_hidden_latents
            latents = self._latent_scale * _one_of(amp_latents, ase_latents)
            return self.value_act(self.value(self.critic_mlp(obs, latents)))

        def eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
            """Return logits (n, 1) of normalised AMP observations (n, F) and latents (n, Z)."""
            scaled = (self._latent_scale * z for z in latents)
            return super().eval_disc(torch.cat((amp_obs, *scaled), dim=-1))

        def eval_enc(self, amp_obs: Tensor) -> Tensor:
            """Return unit vectors (n, Z), the latents inferred from normalised AMP observations."""
            return F.normalize(self._enc(self._enc_mlp(amp_obs)), dim=-1)

        def eval_enc_with_gradient(self, amp_obs: Tensor, latents: Tensor) -> tuple[Tensor, Tensor]:
            """Return latents q(x) and the differentiable gradients (n, F) of -q(x) . z to x."""
            with torch.enable_grad():
                amp_obs = amp_obs.detach().requires_grad_()
                found = self.eval_enc(amp_obs)
            with torch.autocast(amp_obs.device.type, enabled=False):
                error = -(found.float() * latents).sum(dim=-1, keepdim=True)
                return found, input_gradient(error, amp_obs)

        def sample_latents(self, n: int) -> Tensor:
            """Return random unit vectors (n, Z) on the network's device."""
            return sample_latents(n, self._latent_dim, self._enc.weight.device)

        def enc_parameters(self) -> list[nn.Parameter]:
            """Return the encoder's parameters."""
            return [*self._enc_mlp.parameters(), *self._enc.parameters()]

        def get_enc_weights(self) -> list[Tensor]:
            """Return the encoder's weight matrices, flat, without biases."""
            layers = [m for m in self._enc_mlp.modules() if isinstance(m, nn.Linear)]
            return [layer.weight.flatten() for layer in (*layers, self._enc)]

    def build(self, name: str, **kwargs: Any) -> GenAMPBuilder.Network:
        """Build the network."""
        return GenAMPBuilder.Network(self.params, **kwargs)


def _one_of(amp_latents: Tensor | None, ase_latents: Tensor | None) -> Tensor:
    latents = ase_latents if amp_latents is None else amp_latents
    if latents is None:
        raise TypeError("expected latents: amp_latents (or ase_latents), (n, latent_dim)")
    return latents
