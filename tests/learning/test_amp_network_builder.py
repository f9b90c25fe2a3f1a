from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_network_builder import AMPBuilder

NETWORK: dict[str, Any] = {
    "name": "amp",
    "separate": True,
    "space": {
        "continuous": {
            "mu_activation": "None",
            "sigma_activation": "None",
            "mu_init": {"name": "default"},
            "sigma_init": {"name": "const_initializer", "val": -2.9},
            "fixed_sigma": True,
            "learn_sigma": False,
        }
    },
    "mlp": {
        "units": [1024, 512],
        "activation": "relu",
        "d2rl": False,
        "initializer": {"name": "default"},
        "regularizer": {"name": "None"},
    },
    "disc": {"units": [1024, 512], "activation": "relu", "initializer": {"name": "default"}},
}

# Names and shapes of the published humanoid, in the order of the optimiser's parameters.
PUBLISHED = {
    "sigma": (28,),
    "actor_mlp.0.weight": (1024, 105),
    "actor_mlp.0.bias": (1024,),
    "actor_mlp.2.weight": (512, 1024),
    "actor_mlp.2.bias": (512,),
    "critic_mlp.0.weight": (1024, 105),
    "critic_mlp.0.bias": (1024,),
    "critic_mlp.2.weight": (512, 1024),
    "critic_mlp.2.bias": (512,),
    "value.weight": (1, 512),
    "value.bias": (1,),
    "mu.weight": (28, 512),
    "mu.bias": (28,),
    "_disc_mlp.0.weight": (1024, 210),
    "_disc_mlp.0.bias": (1024,),
    "_disc_mlp.2.weight": (512, 1024),
    "_disc_mlp.2.bias": (512,),
    "_disc_logits.weight": (1, 512),
    "_disc_logits.bias": (1,),
}


def build(
    changes: dict[str, Any] | None = None, obs: int = 105, actions: int = 28, amp_obs: int = 210
) -> AMPBuilder.Network:
    """The published network with changes {"dotted.path": value}."""
    params = copy.deepcopy(NETWORK)
    for path, value in (changes or {}).items():
        *sections, key = path.split(".")
        section = params
        for name in sections:
            section = section[name]
        section[key] = value
    builder = AMPBuilder()
    builder.load(params)
    return builder.build(
        "amp",
        actions_num=actions,
        input_shape=(obs,),
        num_seqs=8,
        value_size=1,
        normalize_value=True,
        normalize_input=True,
        amp_input_shape=(amp_obs,),
    )


def tiny(**changes: Any) -> AMPBuilder.Network:
    """Five observations, three actions, seven AMP observations; keys with __ for dots."""
    paths = {path.replace("__", "."): value for path, value in changes.items()}
    units = {"mlp.units": [6, 4], "disc.units": [8, 3]}
    return build({**units, **paths}, obs=5, actions=3, amp_obs=7)


@pytest.fixture(scope="module")
def published() -> AMPBuilder.Network:
    torch.manual_seed(0)
    return build()


def test_names_shapes_and_order_of_the_published_network(published):
    assert [(name, tuple(p.shape)) for name, p in published.named_parameters()] == list(
        PUBLISHED.items()
    )
    assert list(published.state_dict()) == list(PUBLISHED)
    assert sum(p.numel() for p in published.parameters()) == 2_022_970


def test_parameters_are_float32(published):
    assert {p.dtype for p in published.parameters()} == {torch.float32}


def test_a_checkpoint_of_these_names_loads_strictly():
    generator = torch.Generator().manual_seed(3)
    state = {name: torch.rand(shape, generator=generator) for name, shape in PUBLISHED.items()}
    network = build()
    network.load_state_dict(state, strict=True)
    for name, parameter in network.named_parameters():
        assert torch.equal(parameter, state[name]), name


def test_sigma_is_a_constant_without_gradient(published):
    assert published.sigma.requires_grad is False
    assert published.sigma.tolist() == pytest.approx([-2.9] * 28)
    others = {n for n, p in published.named_parameters() if not p.requires_grad}
    assert others == {"sigma"}


def test_sigma_is_learned_if_asked_for():
    network = tiny(space__continuous__learn_sigma=True)
    assert network.sigma.requires_grad is True


def test_all_biases_start_at_zero(published):
    biases = {n: p for n, p in published.named_parameters() if n.endswith("bias")}
    assert len(biases) == 9
    for name, bias in biases.items():
        assert not bias.any(), name


def test_logit_weights_start_uniform_in_minus_one_to_one(published):
    weights = published.get_disc_logit_weights()
    assert weights.shape == (512,)
    assert weights.abs().max() <= 1.0
    # Of 512 uniform numbers: the largest is below 0.97 in 1 of 6e6 draws; the standard deviation is
    # 1/sqrt(3) = 0.577 with a standard error of 0.011.
    assert weights.abs().max() > 0.97
    assert weights.std().item() == pytest.approx(0.577, abs=0.06)


@pytest.mark.parametrize(("name", "fan_in"), [("actor_mlp.0", 105), ("_disc_mlp.2", 1024)])
def test_the_default_initializer_is_pytorchs(published, name, fan_in):
    weight = published.state_dict()[f"{name}.weight"]
    bound = fan_in**-0.5
    assert weight.abs().max() <= bound
    assert weight.abs().max() > 0.999 * bound


def test_the_discriminators_own_initializer_is_used():
    network = tiny(disc__initializer={"name": "const_initializer", "val": 0.25})
    for index in (0, 2):
        weight = network.state_dict()[f"_disc_mlp.{index}.weight"]
        assert torch.equal(weight, torch.full_like(weight, 0.25))
    assert network.get_disc_logit_weights().unique().numel() == 3
    assert network.state_dict()["actor_mlp.0.weight"].unique().numel() == 30


def fill(network: torch.nn.Module, seed: int) -> dict[str, np.ndarray]:
    """Set all parameters to random numbers, biases and sigma included; return them."""
    rng = np.random.default_rng(seed)
    state = {n: rng.normal(size=p.shape) for n, p in network.named_parameters()}
    network.load_state_dict({n: torch.from_numpy(a).float() for n, a in state.items()})
    return state


def numpy_mlp(state: dict[str, np.ndarray], prefix: str, x: np.ndarray, activation) -> np.ndarray:
    for index in (0, 2):
        x = activation(x @ state[f"{prefix}.{index}.weight"].T + state[f"{prefix}.{index}.bias"])
    return x


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0.0)


@pytest.mark.parametrize(("name", "activation"), [("relu", relu), ("tanh", np.tanh)])
def test_forward_agrees_with_numpy(name, activation):
    network = tiny(mlp__activation=name, disc__activation=name)
    state = fill(network, 7)
    rng = np.random.default_rng(8)
    obs, amp_obs = rng.normal(size=(4, 5)), rng.normal(size=(4, 7))

    actor = numpy_mlp(state, "actor_mlp", obs, activation)
    critic = numpy_mlp(state, "critic_mlp", obs, activation)
    disc = numpy_mlp(state, "_disc_mlp", amp_obs, activation)
    expected_mu = actor @ state["mu.weight"].T + state["mu.bias"]
    expected_value = critic @ state["value.weight"].T + state["value.bias"]
    expected_logit = disc @ state["_disc_logits.weight"].T + state["_disc_logits.bias"]

    mu, log_sigma, value, _ = network({"obs": torch.from_numpy(obs).float()})
    logit = network.eval_disc(torch.from_numpy(amp_obs).float())
    # float32 against float64, values of the order of ten
    close: dict[str, Any] = {"rtol": 1e-5, "atol": 1e-5}
    np.testing.assert_allclose(mu.detach().numpy(), expected_mu, **close)
    np.testing.assert_allclose(value.detach().numpy(), expected_value, **close)
    np.testing.assert_allclose(logit.detach().numpy(), expected_logit, **close)
    np.testing.assert_allclose(log_sigma.detach().numpy(), np.tile(state["sigma"], (4, 1)), **close)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"separate": False},
        {"space__continuous__mu_activation": "tanh"},
        {"space__continuous__fixed_sigma": False},
        {"space__continuous__sigma_activation": "tanh"},
        {"mlp__d2rl": True},
        {"mlp__activation": "elu"},
    ],
    ids=lambda changes: "-".join(changes) or "published",
)
def test_the_parts_agree_with_forward(changes):
    network = tiny(**changes)
    fill(network, 5)
    obs = torch.randn(6, 5, generator=torch.Generator().manual_seed(0))
    mu, log_sigma, value, _ = network({"obs": obs})
    own_mu, own_log_sigma = network.eval_actor(obs)
    assert torch.equal(own_mu, mu)
    assert torch.equal(own_log_sigma, log_sigma)
    assert torch.equal(network.eval_critic(obs), value)
    assert value.shape == (6, 1)
    assert log_sigma.shape == mu.shape == (6, 3)


def test_shared_layers_have_no_critic_of_their_own():
    names = [name for name, _ in tiny(separate=False).named_parameters()]
    assert not [name for name in names if name.startswith("critic_mlp")]
    assert "value.weight" in names


def test_discriminator_weights_are_flat_and_without_biases():
    network = tiny()
    state = network.state_dict()
    expected = [state["_disc_mlp.0.weight"], state["_disc_mlp.2.weight"]]
    expected += [state["_disc_logits.weight"]]
    weights = network.get_disc_weights()
    assert [w.shape for w in weights] == [(56,), (24,), (3,)]
    for own, matrix in zip(weights, expected, strict=True):
        assert torch.equal(own, matrix.flatten())
        assert own.requires_grad
    assert torch.equal(network.get_disc_logit_weights(), weights[-1])


@pytest.mark.parametrize("section", ["rnn", "cnn"])
def test_recurrent_and_convolutional_networks_are_refused(section):
    with pytest.raises(ConfigError, match=rf"train\.params\.network\.{section}"):
        tiny(**{section: {"name": "lstm", "units": 8, "layers": 1}})


def test_a_missing_discriminator_is_named():
    builder = AMPBuilder()
    builder.load({k: v for k, v in NETWORK.items() if k != "disc"})
    with pytest.raises(ConfigError, match=r"network\.disc is missing"):
        builder.build("amp", actions_num=3, input_shape=(5,), amp_input_shape=(7,))
