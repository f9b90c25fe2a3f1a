from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.learning.amp_models import ModelAMPContinuous
from isaacgymenvs_lite.learning.amp_network_builder import AMPBuilder

OBS, ACTIONS, AMP_OBS = 5, 3, 7
ACTING = {"neglogpacs", "values", "actions", "rnn_states", "mus", "sigmas"}
TRAINING = {"prev_neglogp", "values", "entropy", "rnn_states", "mus", "sigmas"}
LOGITS = {"disc_agent_logit", "disc_agent_replay_logit", "disc_demo_logit", "disc_demo_gradient"}


@pytest.fixture
def make_model():
    def make(**changes: Any) -> Any:
        torch.manual_seed(0)
        builder = AMPBuilder()
        builder.load(
            {
                "separate": True,
                "space": {
                    "continuous": {
                        "mu_activation": "None",
                        "sigma_activation": "None",
                        "mu_init": {"name": "default"},
                        "sigma_init": {"name": "const_initializer", "val": -1.0},
                        "fixed_sigma": True,
                    }
                },
                "mlp": {"units": [6, 4], "activation": "relu", "initializer": {"name": "default"}},
                "disc": {"units": [8, 3], "activation": "relu"},
            }
        )
        return ModelAMPContinuous(builder).build(
            {
                "actions_num": ACTIONS,
                "input_shape": (OBS,),
                "num_seqs": 4,
                "value_size": 1,
                "normalize_value": True,
                "normalize_input": True,
                "amp_input_shape": (AMP_OBS,),
                **changes,
            }
        )

    return make


def random(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def training_input(rows: int = 6, amp_rows: int = 4) -> dict[str, Any]:
    return {
        "is_train": True,
        "obs": random(rows, OBS),
        "prev_actions": random(rows, ACTIONS, seed=2),
        "amp_obs": random(amp_rows, AMP_OBS, seed=3),
        "amp_obs_replay": random(amp_rows, AMP_OBS, seed=4),
        "amp_obs_demo": random(amp_rows, AMP_OBS, seed=5).requires_grad_(True),
    }


def test_wrapper_keys_stand_beside_the_network(make_model):
    state = make_model().state_dict()
    wrapper = {k: v for k, v in state.items() if not k.startswith("a2c_network.")}
    assert {k: (tuple(v.shape), v.dtype) for k, v in wrapper.items()} == {
        "value_mean_std.running_mean": ((1,), torch.float64),
        "value_mean_std.running_var": ((1,), torch.float64),
        "value_mean_std.count": ((), torch.float64),
        "running_mean_std.running_mean": ((OBS,), torch.float64),
        "running_mean_std.running_var": ((OBS,), torch.float64),
        "running_mean_std.count": ((), torch.float64),
    }
    assert list(state)[6] == "a2c_network.sigma"
    assert list(state)[-1] == "a2c_network._disc_logits.bias"


def test_without_normalisers_there_are_no_wrapper_keys(make_model):
    state = make_model(normalize_value=False, normalize_input=False).state_dict()
    assert all(key.startswith("a2c_network.") for key in state)


def test_output_keys(make_model):
    model = make_model()
    acting = model({"is_train": False, "obs": random(4, OBS), "prev_actions": None})
    assert set(acting) == ACTING
    inputs = training_input()
    assert set(model(inputs)) == TRAINING | LOGITS
    plain = {k: v for k, v in training_input().items() if not k.startswith("amp_obs")}
    assert set(model(plain)) == TRAINING


def test_each_kind_of_amp_observation_gets_its_own_logits(make_model):
    model = make_model()
    inputs = training_input()
    result = model(inputs)
    for name, key in (
        ("disc_agent_logit", "amp_obs"),
        ("disc_agent_replay_logit", "amp_obs_replay"),
        ("disc_demo_logit", "amp_obs_demo"),
    ):
        assert result[name].shape == (4, 1)
        expected = model.a2c_network.eval_disc(inputs[key])
        # one matrix product over eight rows or over four: rounding only
        torch.testing.assert_close(result[name], expected, rtol=1e-6, atol=1e-6)


def test_the_logits_of_demonstrations_can_be_differentiated_twice(make_model):
    inputs, model = training_input(), make_model()
    gradient = model(inputs)["disc_demo_gradient"]
    demo = inputs["amp_obs_demo"].detach().requires_grad_()
    (expected,) = torch.autograd.grad(model.a2c_network.eval_disc(demo).sum(), demo)
    torch.testing.assert_close(gradient, expected)
    gradient.square().sum().backward()
    first_layer = model.a2c_network.get_parameter("_disc_mlp.0.weight")
    assert first_layer.grad.abs().sum() > 0


def test_training_statistics_against_formulas(make_model):
    model = make_model().eval()
    inputs = training_input()
    obs, actions = inputs["obs"].double(), inputs["prev_actions"].double()
    result = model(inputs)
    sigma = math.exp(-1.0)
    mu = result["mus"].detach().double()
    neglogp = (
        0.5 * (((actions - mu) / sigma) ** 2).sum(1)
        + 0.5 * ACTIONS * math.log(2 * math.pi)
        + ACTIONS * math.log(sigma)
    )
    torch.testing.assert_close(
        result["prev_neglogp"].detach().double(), neglogp, rtol=1e-5, atol=1e-5
    )
    entropy = ACTIONS * (0.5 + 0.5 * math.log(2 * math.pi) + math.log(sigma))
    assert result["entropy"].tolist() == pytest.approx([entropy] * 6, abs=1e-5)
    assert result["sigmas"].flatten().tolist() == pytest.approx([sigma] * 18)
    # the model leaves the normalised observation behind: mean 0, variance 1 still
    torch.testing.assert_close(
        inputs["obs"].double(), obs / math.sqrt(1 + 1e-5), rtol=1e-6, atol=1e-6
    )


def test_values_are_denormalised_for_acting_and_normalised_for_training(make_model):
    model = make_model().eval()
    model.value_mean_std.running_mean.fill_(10.0)
    model.value_mean_std.running_var.fill_(4.0)
    raw = model({**training_input(), "is_train": True})["values"]
    acting = model({"is_train": False, "obs": random(6, OBS), "prev_actions": None})["values"]
    expected = 10.0 + math.sqrt(4.0 + 1e-5) * raw
    torch.testing.assert_close(acting, expected, rtol=1e-6, atol=1e-6)
    assert raw.abs().max() < 5.0


def test_observations_are_normalised_by_the_models_own_statistics(make_model):
    model = make_model().eval()
    model.running_mean_std.running_mean.copy_(torch.arange(OBS))
    model.running_mean_std.running_var.fill_(9.0)
    obs = random(6, OBS)
    expected = (obs - torch.arange(OBS)) / math.sqrt(9.0 + 1e-5)
    mu, _ = model.a2c_network.eval_actor(expected)
    result = model({"is_train": False, "obs": obs, "prev_actions": None})
    torch.testing.assert_close(result["mus"], mu, rtol=1e-5, atol=1e-6)


def test_training_updates_the_statistics_before_it_uses_them(make_model):
    model = make_model().train()
    inputs = training_input(rows=8)
    obs = inputs["obs"].double().numpy()
    model(inputs)
    # merged with one imaginary row of mean 0 and variance 1
    mean = obs.mean(0) * 8 / 9
    var = (1.0 + obs.var(0) * 8 + obs.mean(0) ** 2 * 8 / 9) / 9
    statistics = model.running_mean_std
    np.testing.assert_allclose(statistics.running_mean.numpy(), mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(statistics.running_var.numpy(), var, rtol=1e-5, atol=1e-6)
    assert statistics.count.item() == 9.0
    np.testing.assert_allclose(
        inputs["obs"].numpy(), (obs - mean) / np.sqrt(var + 1e-5), rtol=1e-5, atol=1e-5
    )


def test_the_discriminator_alone_hears_the_noise(make_model):
    model = make_model()
    kinds = ("amp_obs", "amp_obs_replay", "amp_obs_demo")
    inputs = training_input()
    noise = {
        f"{kind}_noise": torch.full_like(inputs[kind], i + 0.5) for i, kind in enumerate(kinds)
    }
    shifted = {kind: inputs[kind] + noise[f"{kind}_noise"] for kind in kinds}
    found, expected = model({**inputs, **noise}), model({**inputs, **shifted})
    assert set(found) == set(expected)
    for name in ("disc_agent_logit", "disc_agent_replay_logit", "disc_demo_logit"):
        torch.testing.assert_close(found[name], expected[name])
        assert (found[name] - model(inputs)[name]).abs().max() > 1e-3
