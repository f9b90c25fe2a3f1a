from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
import torch.nn.functional as F

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.cpu.parallel import ParallelNetwork
from isaacgymenvs_lite.learning.gen_amp_network_builder import GenAMPBuilder
from tests.learning.test_amp_network_builder import NETWORK as AMP_NETWORK

UNITS = [1024, 1024, 512]
NETWORK: dict[str, Any] = {
    **AMP_NETWORK,
    "name": "gen_amp",
    "mlp": {**AMP_NETWORK["mlp"], "units": UNITS},
    "disc": {**AMP_NETWORK["disc"], "units": UNITS},
    "enc": {**AMP_NETWORK["disc"], "units": [1024, 512], "separate": False},
}
OBS, ACTIONS, AMP_OBS, LATENT = 253, 31, 1400, 64


def linear(name: str, outputs: int, inputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


# ASE's sword-and-shield humanoid: names and shapes in the order of the checkpoint.
PUBLISHED = {
    "sigma": (31,),
    **linear("actor_mlp._style_mlp.0", 512, 64),
    **linear("actor_mlp._style_mlp.2", 256, 512),
    **linear("actor_mlp._style_dense", 64, 256),
    **linear("actor_mlp._dense_layers.0", 1024, 317),
    **linear("actor_mlp._dense_layers.1", 1024, 1024),
    **linear("actor_mlp._dense_layers.2", 512, 1024),
    **linear("critic_mlp._mlp.0", 1024, 317),
    **linear("critic_mlp._mlp.2", 1024, 1024),
    **linear("critic_mlp._mlp.4", 512, 1024),
    **linear("value", 1, 512),
    **linear("mu", 31, 512),
    **linear("_disc_mlp.0", 1024, 1400),
    **linear("_disc_mlp.2", 1024, 1024),
    **linear("_disc_mlp.4", 512, 1024),
    **linear("_disc_logits", 1, 512),
    **linear("_enc_mlp.0", 1024, 1400),
    **linear("_enc_mlp.2", 1024, 1024),
    **linear("_enc_mlp.4", 512, 1024),
    **linear("_enc", 64, 512),
}


def build(changes: dict[str, Any] | None = None, sizes: tuple[int, ...] = ()) -> Any:
    """The published network with changes {"dotted.path": value}; None removes."""
    obs, actions, amp_obs, latent = sizes or (OBS, ACTIONS, AMP_OBS, LATENT)
    params = copy.deepcopy(NETWORK)
    for path, value in (changes or {}).items():
        *sections, key = path.split(".")
        section = params
        for name in sections:
            section = section[name]
        if value is None:
            del section[key]
        else:
            section[key] = value
    builder = GenAMPBuilder()
    builder.load(params)
    return builder.build(
        "gen_amp",
        actions_num=actions,
        input_shape=(obs,),
        num_seqs=8,
        value_size=1,
        amp_input_shape=(amp_obs,),
        amp_latent_shape=(latent,),
    )


SMALL = {"mlp.units": [12, 8], "disc.units": [10, 6], "style": {"units": [9, 7]}}
SMALL_SIZES = (5, 3, 11, 4)


@pytest.fixture
def small() -> Any:
    torch.manual_seed(0)
    return build(SMALL, SMALL_SIZES)


def random(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def unit(*shape: int, seed: int = 1) -> torch.Tensor:
    return F.normalize(random(*shape, seed=seed), dim=-1)


def test_names_and_shapes_are_those_of_ase():
    network = build()
    state = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert state == PUBLISHED
    assert list(state) == list(PUBLISHED)
    assert sum(p.numel() for p in network.parameters()) == 7_039_936
    shared = network.state_dict()
    assert shared["_enc_mlp.0.weight"].data_ptr() == shared["_disc_mlp.0.weight"].data_ptr()
    assert not network.sigma.requires_grad


def test_an_encoder_of_its_own():
    network = build({"enc.separate": True})
    state = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    expected = {name: shape for name, shape in PUBLISHED.items() if "_enc_mlp" not in name}
    expected |= {**linear("_enc_mlp.0", 1024, 1400), **linear("_enc_mlp.2", 512, 1024)}
    assert state == expected
    before = network.eval_disc(random(2, AMP_OBS))
    with torch.no_grad():
        network._enc_mlp[0].weight.zero_()
    assert torch.equal(network.eval_disc(random(2, AMP_OBS)), before)


def test_initialisation():
    torch.manual_seed(0)
    network = build()
    for name, parameter in network.named_parameters():
        if name.endswith("bias"):
            assert not parameter.any(), name
    # the largest of thousands of uniform numbers is near the end of their range
    for layer, scale in ((network.actor_mlp._style_dense, 1.0), (network._enc, 0.1)):
        assert 0.99 * scale < layer.weight.abs().max() <= scale
    assert 0.9 < network._disc_logits.weight.abs().max() <= 1.0
    # PyTorch's own: U(+-1/sqrt(inputs))
    for layer in (network.actor_mlp._dense_layers[0], network.critic_mlp._mlp[0]):
        assert 0.99 * 317**-0.5 < layer.weight.abs().max() <= 317**-0.5
    assert network.sigma.unique().tolist() == pytest.approx([-2.9])


def test_actor_and_critic_by_hand(small):
    obs, latents = random(6, 5), unit(6, 4, seed=2)
    state = {name: value.double() for name, value in small.state_dict().items()}

    def layer(name: str, x: torch.Tensor) -> torch.Tensor:
        return x @ state[f"{name}.weight"].T + state[f"{name}.bias"]

    style = layer("actor_mlp._style_mlp.0", latents.double()).relu()
    style = layer("actor_mlp._style_mlp.2", style).relu()
    style = layer("actor_mlp._style_dense", style).tanh()
    x = torch.cat((obs.double(), style), dim=-1)
    for i in range(2):
        x = layer(f"actor_mlp._dense_layers.{i}", x).relu()
    mu, logstd = small.eval_actor(obs, latents)
    torch.testing.assert_close(mu.double(), layer("mu", x), rtol=1e-5, atol=1e-6)
    assert logstd.unique().tolist() == pytest.approx([-2.9])

    x = torch.cat((obs, latents), dim=-1).double()  # the critic hears the latent itself
    for i in (0, 2):
        x = layer(f"critic_mlp._mlp.{i}", x).relu()
    value = small.eval_critic(obs, latents)
    torch.testing.assert_close(value.double(), layer("value", x), rtol=1e-5, atol=1e-6)

    outputs = small({"obs": obs, "amp_latents": latents})
    for own, other in zip(outputs, (mu, logstd, value), strict=False):
        assert torch.equal(own, other)
    assert outputs[3] is None


def test_ases_keyword_and_given_styles(small):
    obs, latents = random(6, 5), unit(6, 4, seed=2)
    mu, _ = small.eval_actor(obs, amp_latents=latents)
    assert torch.equal(small.eval_actor(obs, ase_latents=latents)[0], mu)
    assert torch.equal(small.eval_critic(obs, ase_latents=latents), small.eval_critic(obs, latents))
    styles = small.actor_mlp.eval_style(latents)
    assert torch.equal(small.eval_actor(obs, styles, use_hidden_latents=True)[0], mu)
    with pytest.raises(TypeError, match="amp_latents"):
        small.eval_actor(obs)


def test_the_encoder_points_at_the_sphere_and_its_gradient_is_that_of_its_error(small):
    amp_obs, latents = random(6, 11), unit(6, 4, seed=2)
    found = small.eval_enc(amp_obs)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(6))
    again, gradient = small.eval_enc_with_gradient(amp_obs, latents)
    assert torch.equal(again, found)
    # central differences of -q . z in float64
    small.double()
    x, z = amp_obs.double(), latents.double()
    for i in range(11):
        step = torch.zeros(11, dtype=torch.float64)
        step[i] = 1e-6
        ahead, behind = (-(small.eval_enc(y) * z).sum(-1) for y in (x + step, x - step))
        torch.testing.assert_close(
            gradient[:, i].double(), (ahead - behind) / 2e-6, rtol=1e-3, atol=1e-5
        )


def test_weights_and_random_latents(small):
    weights = small.get_enc_weights()
    assert [len(w) for w in weights] == [110, 60, 24]
    assert [len(w) for w in small.get_disc_weights()] == [110, 60, 6]
    latents = small.sample_latents(7)
    assert latents.shape == (7, 4)
    torch.testing.assert_close(latents.norm(dim=-1), torch.ones(7))


def test_several_threads_give_the_same(small):
    obs, latents = random(512, 5), unit(512, 4, seed=2)
    amp_obs = random(512, 11, seed=3)

    def outputs(network: Any) -> list[torch.Tensor]:
        return [
            *network({"obs": obs, "amp_latents": latents})[:3],
            network.eval_actor(obs, latents, use_hidden_latents=True)[0],
            network.eval_critic(obs, ase_latents=latents),
            *network.eval_enc_with_gradient(amp_obs, latents),
        ]

    parallel = ParallelNetwork(small, "cpu", num_threads=2)
    for own, other in zip(outputs(parallel), outputs(small), strict=True):
        torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"enc": None}, "network.enc is missing"),
        ({"separate": False}, "network.separate=False"),
        ({"style": {"units": []}}, r"style.units=\[\]"),
        ({"mlp.units": []}, r"mlp.units=\[\]"),
        ({"disc": None}, "network.disc is missing"),
    ],
)
def test_networks_that_cannot_be_built(changes, words):
    with pytest.raises(ConfigError, match=words):
        build({**SMALL, **changes}, SMALL_SIZES) if "disc" not in changes else build(changes)


def test_latents_are_heard_as_long_as_asked_for():
    own, disc = "latent_scale", {"disc.conditional": True, "enc.separate": True}
    plain, longer = (build({**SMALL, **disc, own: scale}, SMALL_SIZES) for scale in (1.0, 5.0))
    longer.load_state_dict(plain.state_dict())
    obs, amp_obs, latents = random(6, 5), random(6, 11), unit(6, 4)
    for name, first in (("eval_actor", obs), ("eval_critic", obs), ("eval_disc", amp_obs)):
        expected = getattr(plain, name)(first, 5.0 * latents)
        found = getattr(longer, name)(first, latents)
        for value, other in zip(found, expected, strict=True):  # the actor gives two tensors
            torch.testing.assert_close(value, other)
    styles = plain.actor_mlp.eval_style(5.0 * latents)
    found, _ = longer.eval_actor(obs, styles, use_hidden_latents=True)
    torch.testing.assert_close(found, longer.eval_actor(obs, latents)[0])
    # What the encoder finds, and what the losses compare, stay unit vectors.
    torch.testing.assert_close(longer.eval_enc(amp_obs), plain.eval_enc(amp_obs))
