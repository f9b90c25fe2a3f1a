"""Checks of `train.params.network`: what rl_games would stumble over long after the start."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.schema import check_unknown_keys, keys_of, missing_key, read_section, setting

_log = logging.getLogger(__name__)

# The names in the factories of rl_games' network builder.
ACTIVATIONS = ("relu", "tanh", "sigmoid", "elu", "selu", "swish", "gelu", "softplus", "None")
INITIALIZERS = (
    "default",
    "const_initializer",
    "orthogonal_initializer",
    "orthogonal",
    "glorot_normal_initializer",
    "glorot_uniform_initializer",
    "variance_scaling_initializer",
    "random_uniform_initializer",
    "kaiming_normal",
)

# Networks made of an `mlp` section, and the sections of hidden layers that they may have.
_MLP_NETWORKS = frozenset(("actor_critic", "amp", "gen_amp", "ase", "hrl"))
_SAC_NETWORK = "soft_actor_critic"
_LATENT_NETWORKS = ("gen_amp", "ase")
_LAYER_SECTIONS = ("mlp", "disc", "enc")
_KEYS = frozenset(
    (
        *_LAYER_SECTIONS,
        *("name", "separate", "space", "rnn", "cnn", "inputs", "normalization", "value_shape"),
        *("value_activation", "central_value", "joint_obs_actions", "permute_input"),
        *("use_hidden_latents", "latent_dim", "latent_scale", "style"),
        *("log_std_bounds", "layer_norm"),
    )
)


@dataclass(frozen=True, kw_only=True)
class LayerSettings:
    """Hidden layers: the sections mlp, disc and enc."""

    units: tuple[int, ...] = setting(minimum=1)
    """Width of each layer."""
    activation: str = setting(choices=ACTIVATIONS)
    initializer: Mapping[str, Any] = setting({"name": "default"})
    regularizer: Mapping[str, Any] | None = setting(None)
    d2rl: bool = setting(False)
    norm_only_first_layer: bool = setting(False)
    separate: bool = setting(False)
    """Encoder: False shares the discriminator's layers."""
    conditional: bool = setting(False)
    """Discriminator: hears the latent, too."""
    model_size_multiplier: float = setting(1, above=0)
    """Factor on all units, applied before the network is built."""


@dataclass(frozen=True, kw_only=True)
class LatentSettings:
    """Keys of the network itself that are about latents."""

    latent_scale: float = setting(1.0, above=0)
    """How long the latents are that it hears."""


@dataclass(frozen=True, kw_only=True)
class GaussianSettings:
    """The section space.continuous: the distribution of the actions."""

    mu_activation: str = setting(choices=ACTIVATIONS)
    sigma_activation: str = setting(choices=ACTIVATIONS)
    mu_init: Mapping[str, Any] = setting()
    sigma_init: Mapping[str, Any] = setting()
    fixed_sigma: Any = setting()
    learn_sigma: bool = setting(True)


def check_network(network: Mapping[str, Any], where: str) -> None:
    """Check names, units and keys of a network section.

    Raises:
        ConfigError: a key is missing or misspelt, or a value is none of the choices.
    """
    if network["name"] in _MLP_NETWORKS:
        check_unknown_keys(network, _KEYS, where)
        if "mlp" not in network:
            raise missing_key("mlp", network, _KEYS, where, "expected the hidden layers' section")
        if network.get("inputs"):
            _log.warning(
                "%s.inputs: the tasks observe one vector, not named parts; no effect", where
            )
    own = {key: network[key] for key in keys_of(LatentSettings) if key in network}
    read_section(LatentSettings, own, where)
    for section in _LAYER_SECTIONS:
        if section in network:
            path = f"{where}.{section}"
            layers = read_section(LayerSettings, network[section], path)
            _check_initializer(layers.initializer, f"{path}.initializer")
    if network.get("disc", {}).get("conditional") and network["name"] not in _LATENT_NETWORKS:
        raise ConfigError(
            f"{where}.disc.conditional=True: the network {network['name']} has no latents that a"
            f" discriminator could hear; expected {where}.name: {' or '.join(_LATENT_NETWORKS)}"
        )
    space = network.get("space") or {}
    # Soft actor-critic's distribution has no settings: its files leave the section empty.
    if isinstance(space, Mapping) and "continuous" in space and network["name"] != _SAC_NETWORK:
        path = f"{where}.space.continuous"
        gaussian = read_section(GaussianSettings, space["continuous"], path)
        _check_initializer(gaussian.mu_init, f"{path}.mu_init")
        _check_initializer(gaussian.sigma_init, f"{path}.sigma_init")


def scale_units(network: dict[str, Any]) -> None:
    """Multiply the mlp's units by its model_size_multiplier, in place."""
    mlp = network.get("mlp")
    if not isinstance(mlp, dict):
        return
    factor = mlp.get("model_size_multiplier", 1)
    if factor != 1:
        mlp["units"] = [max(1, int(units * factor)) for units in mlp["units"]]
        mlp["model_size_multiplier"] = 1  # once is enough, should the section be read again


def _check_initializer(initializer: Mapping[str, Any], where: str) -> None:
    name = initializer.get("name")
    if name is None:
        raise ConfigError(f"{where}: the key 'name' is missing; choices: {', '.join(INITIALIZERS)}")
    if name not in INITIALIZERS:
        raise ConfigError(f"{where}.name: " + unknown("initializer", str(name), INITIALIZERS))
