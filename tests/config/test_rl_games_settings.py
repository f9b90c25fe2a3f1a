import copy
from typing import Any

import pytest

from isaacgymenvs_lite.config.rl_games_settings import check_network, scale_units
from isaacgymenvs_lite.errors import ConfigError

LAYERS = {"units": [8, 4], "activation": "relu", "initializer": {"name": "default"}}
NETWORK = {
    "name": "amp",
    "separate": True,
    "mlp": LAYERS,
    "disc": copy.deepcopy(LAYERS),
    "space": {
        "continuous": {
            "mu_activation": "None",
            "sigma_activation": "None",
            "mu_init": {"name": "default"},
            "sigma_init": {"name": "const_initializer", "val": -2.9},
            "fixed_sigma": True,
        }
    },
}
ABSENT = object()


def changed(path: str, value: Any) -> dict[str, Any]:
    network = copy.deepcopy(NETWORK)
    section: dict[str, Any] = network
    *parents, key = path.split(".")
    for parent in parents:
        section = section[parent]
    if value is ABSENT:
        del section[key]
    else:
        section[key] = value
    return network


def test_published_networks_pass():
    check_network(NETWORK, "n")
    check_network(changed("mlp.d2rl", False), "n")
    check_network(changed("mlp.regularizer", {"name": "None"}), "n")
    check_network(changed("enc", {**LAYERS, "separate": False}), "n")
    check_network(changed("latent_scale", 8), "n")
    check_network({**changed("disc.conditional", True), "name": "gen_amp"}, "n")
    check_network(changed("rnn", {"name": "lstm", "units": 8, "layers": 1}), "n")


def test_sac_needs_a_hidden_layer():
    network = {**changed("mlp.units", []), "name": "soft_actor_critic"}
    with pytest.raises(ConfigError, match=r"n\.mlp\.units: got \[\], expected at least one"):
        check_network(network, "n")
    check_network(changed("mlp.units", []), "n")


def test_wrong_values():
    for path, value, message in [
        ("mlp.units", [64, -1], r"n\.mlp\.units: got \[64, -1\]"),
        ("mlp.units", "64", r"n\.mlp\.units: got '64', expected a list of whole numbers"),
        ("disc.units", [1.5], r"n\.disc\.units"),
        ("latent_scale", 0, r"n\.latent_scale: got 0, expected .*above 0"),
        ("disc.conditional", True, r"no latents .*; expected n\.name: gen_amp or ase"),
        ("disc.conditional", "perhaps", r"n\.disc\.conditional: got 'perhaps'"),
        ("mlp.activation", "rely", r"n\.mlp\.activation: got 'rely', expected one of relu, tanh"),
        ("mlp.activation", ABSENT, r"'n\.mlp\.activation' is missing"),
        ("mlp.initializer", {"name": "deflt"}, r"n\.mlp\.initializer\.name: .*mean 'default'"),
        ("mlp.initializer", {}, r"n\.mlp\.initializer: the key 'name' is missing"),
        ("mlp", ABSENT, r"'n\.mlp' is missing"),
        ("mpl", LAYERS, None),
        ("space.continuous.mu_activation", "none", r"mu_activation: got 'none'"),
        ("space.continuous.sigma_init", {"name": "constant"}, r"unknown initializer 'constant'"),
        ("space.continuous.sigma_init", ABSENT, r"sigma_init' is missing"),
    ]:
        if message is None:  # a key too many beside the right one: logged, not refused
            check_network(changed(path, value), "n")
            continue
        with pytest.raises(ConfigError, match=message):
            check_network(changed(path, value), "n")


def test_misspelt_section():
    network = changed("mlp", ABSENT)
    network["mpl"] = LAYERS
    with pytest.raises(ConfigError, match=r"'n\.mlp' is missing \(is 'mpl' misspelt\?\)"):
        check_network(network, "n")


def test_units_are_scaled_once():
    for factor, units in [(1, [8, 4]), (2, [16, 8]), (0.5, [4, 2]), (0.1, [1, 1])]:
        network = changed("mlp.model_size_multiplier", factor)
        for _ in range(2):
            scale_units(network)
        assert network["mlp"]["units"] == units
        assert network["disc"]["units"] == [8, 4]
