from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_config import AMPParams, read_agent_params
from isaacgymenvs_lite.learning.modules.discriminator import (
    AMPObsShape,
    StyleDiscriminator,
    StyleLosses,
    StyleNetwork,
    disc_obs_size,
    eval_discriminator,
)

PARAMS: dict[str, Any] = {
    "task_reward_w": 0.0,
    "disc_reward_w": 1.0,
    "amp_obs_demo_buffer_size": 10,
    "amp_replay_buffer_size": 10,
    "amp_replay_keep_prob": 0.1,
    "amp_batch_size": 4,
    "amp_minibatch_size": 4,
    "disc_coef": 5.0,
    "disc_logit_reg": 0.0,
    "disc_grad_penalty": 0.0,
    "disc_reward_scale": 1.0,
    "disc_weight_decay": 0.0,
    "normalize_amp_input": False,
}
# learning.md 3.3
LOGITS = [-2.0, 0.0, 1.0, 3.0, 12.0]
LOGISTIC = [0.126928, 0.693147, 1.313262, 3.048587, 9.210340]
LEAST_SQUARES = [0.0, 0.75, 1.0, 0.0, 0.0]


class Smooth:
    """The logit v . tanh(W x); `calls` has the number of rows of each evaluation."""

    def __init__(self, w: torch.Tensor, v: torch.Tensor) -> None:
        self.w, self.v = w, v
        self.calls: list[int] = []

    def eval_disc(self, amp_obs: torch.Tensor) -> torch.Tensor:
        self.calls.append(len(amp_obs))
        return torch.tanh(amp_obs @ self.w.T) @ self.v.unsqueeze(-1)

    def get_disc_logit_weights(self) -> torch.Tensor:
        return self.v.flatten()

    def get_disc_weights(self) -> list[torch.Tensor]:
        return [self.w.flatten(), self.v.flatten()]


class Linear(Smooth):
    """The logit v . x."""

    def eval_disc(self, amp_obs: torch.Tensor) -> torch.Tensor:
        self.calls.append(len(amp_obs))
        return amp_obs @ self.v.unsqueeze(-1)


def make(network: Any = None, default: str = "logistic", **changes: Any) -> Any:
    if network is None:
        network = Linear(torch.zeros(1, 1), torch.ones(1))
    params = AMPParams(**{**PARAMS, **changes})
    return StyleDiscriminator(network, network.v.shape[0], params, default, "cpu")


class Losses(StyleLosses):
    """The losses of an agent with this discriminator."""

    def __init__(self, discriminator: StyleDiscriminator) -> None:
        self.discriminator = discriminator


def column(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers).unsqueeze(-1)


# --- reward -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"default": "logistic"}, LOGISTIC),
        ({"default": "least_squares"}, LEAST_SQUARES),
        ({"default": "logistic", "disc_reward": "least_squares"}, LEAST_SQUARES),
        ({"default": "least_squares", "disc_reward": "logistic"}, LOGISTIC),
    ],
    ids=["logistic", "least_squares", "key-least_squares", "key-logistic"],
)
def test_rewards_of_the_table(changes, expected):
    rewards = make(**changes, disc_reward_scale=2.0).reward_from_logits(torch.tensor(LOGITS))
    # the table has six decimals
    assert rewards.tolist() == pytest.approx([2.0 * r for r in expected], abs=2e-6)


def test_extreme_logits_give_finite_rewards():
    for kind in ("logistic", "least_squares"):
        rewards = make(disc_reward=kind).reward_from_logits(torch.tensor([-1e4, 1e4, 90.0]))
        assert rewards.isfinite().all()
        assert (rewards >= 0).all()


def test_a_whole_rollout_is_rewarded_in_shape():
    discriminator = make(disc_reward="least_squares")
    amp_obs = torch.tensor(LOGITS).view(5, 1, 1).expand(5, 3, 1)
    rewards = discriminator.reward(amp_obs)
    assert rewards.shape == (5, 3, 1)
    expected = torch.tensor(LEAST_SQUARES).view(5, 1, 1).expand(5, 3, 1)
    torch.testing.assert_close(rewards, expected)
    assert not rewards.requires_grad


def test_rows_keep_their_places_when_a_rollout_is_cut_up():
    network = Linear(torch.zeros(1, 1), torch.ones(1))
    discriminator = make(network)
    amp_obs = torch.arange(20_000.0).view(10, 2000, 1)
    assert torch.equal(discriminator.logits(amp_obs), amp_obs)
    assert len(network.calls) > 1
    assert sum(network.calls) == 20_000


# --- normaliser -------------------------------------------------------------------------------


def test_the_statistics_are_of_all_rows_so_far():
    discriminator = make(normalize_amp_input=True)
    data = torch.tensor([[2.0], [4.0], [9.0]])
    discriminator.normalizer.count_in(data)
    normalized = discriminator.normalize(data)
    # three rows (mean 5, variance 26/3) merged with one of mean 0 and variance 1
    mean = 15 / 4
    var = (1 + 26 + 25 * 3 / 4) / 4
    expected = (data - mean) / np.sqrt(var + 1e-5)
    torch.testing.assert_close(normalized, expected, rtol=1e-6, atol=1e-6)
    # normalising changes nothing
    torch.testing.assert_close(discriminator.normalize(data), expected, rtol=1e-6, atol=1e-6)
    assert discriminator.normalizer.count.item() == 4.0


def test_normalised_numbers_are_limited_to_five():
    discriminator = make(normalize_amp_input=True)
    assert discriminator.normalize(torch.tensor([[100.0], [-100.0]])).tolist() == [[5.0], [-5.0]]


def test_rewards_do_not_move_the_statistics_but_use_them():
    discriminator = make(normalize_amp_input=True, disc_reward="least_squares")
    discriminator.normalizer.running_mean.fill_(3.0)
    discriminator.normalizer.running_var.fill_(4.0)
    before = {k: v.clone() for k, v in discriminator.normalizer.state_dict().items()}
    # (4 - 3) / 2 = 0.5, and the logit is the observation
    rewards = discriminator.reward(torch.full((2, 3, 1), 4.0))
    # 1 - .25 * .5^2; epsilon 1e-5 beside a variance of 4 changes the sixth digit
    assert rewards.flatten().tolist() == pytest.approx([0.9375] * 6, abs=1e-5)
    for name, value in discriminator.normalizer.state_dict().items():
        assert torch.equal(value, before[name])
    assert not discriminator.normalizer.training


def test_without_normaliser_observations_pass_unchanged():
    discriminator = make(normalize_amp_input=False)
    assert discriminator.normalizer is None
    data = torch.tensor([[123.0]])
    assert torch.equal(discriminator.normalize(data), data)
    assert discriminator.checkpoint_modules == {}


# --- loss -------------------------------------------------------------------------------------

AGENT, DEMO = (-1.0, 0.5, 0.0, 2.0), (1.0, -0.5)


def example_loss(network: Any, **changes: Any) -> dict[str, torch.Tensor]:
    """Loss for the logits of learning.md 3.2; the demonstrations' depend on their input."""
    demo_obs = column(*DEMO).requires_grad_(True)
    return Losses(make(network, **changes))._disc_loss(
        column(*AGENT), network.eval_disc(demo_obs), demo_obs
    )


def test_prediction_loss_of_the_example():
    network = Linear(torch.zeros(1, 1), torch.ones(1))
    info = example_loss(network)
    # 0.5 * (1.026853 + 0.643669)
    assert info["disc_loss"].item() == pytest.approx(0.835261, abs=1e-6)
    assert info["disc_agent_acc"].item() == 0.25
    assert info["disc_demo_acc"].item() == 0.5
    assert info["disc_agent_logit"].flatten().tolist() == list(AGENT)
    assert info["disc_demo_logit"].flatten().tolist() == list(DEMO)


def test_least_squares_loss_of_the_example():
    network = Linear(torch.zeros(1, 1), torch.ones(1))
    info = example_loss(network, disc_loss="least_squares")
    # (0 + 2.25 + 1 + 9) / 4 and (0 + 2.25) / 2
    assert info["disc_loss"].item() == pytest.approx(0.5 * (3.0625 + 1.125), abs=1e-6)


def test_agents_are_the_fakes_and_demonstrations_the_real_ones():
    network = Linear(torch.zeros(1, 1), torch.ones(1))
    for kind in ("bce", "least_squares"):
        losses = Losses(make(network, disc_loss=kind))
        demo = column(1.0).requires_grad_(True)
        good = losses._disc_loss(column(-1.0), network.eval_disc(demo), demo)
        demo = column(-1.0).requires_grad_(True)
        bad = losses._disc_loss(column(1.0), network.eval_disc(demo), demo)
        assert good["disc_loss"] < bad["disc_loss"]
        assert good["disc_agent_acc"] == good["disc_demo_acc"] == 1.0
        assert bad["disc_agent_acc"] == bad["disc_demo_acc"] == 0.0


def test_regularisation_terms_add_up():
    network = Linear(torch.tensor([[3.0]]), torch.tensor([1.0]))
    plain = example_loss(network)["disc_loss"].item()
    info = example_loss(network, disc_logit_reg=0.05)
    assert info["disc_logit_loss"].item() == 1.0
    assert info["disc_loss"].item() == pytest.approx(plain + 0.05 * 1.0, abs=1e-6)
    info = example_loss(network, disc_weight_decay=0.01)
    # all weight matrices, last layer included: 3^2 + 1^2
    assert info["disc_loss"].item() == pytest.approx(plain + 0.01 * 10.0, abs=1e-6)
    info = example_loss(network, disc_grad_penalty=0.2)
    assert info["disc_loss"].item() == pytest.approx(plain + 0.2 * 1.0, abs=1e-6)


def test_the_weight_in_force_is_the_scheduled_one():
    network = Linear(torch.zeros(1, 3), torch.tensor([1.0, -2.0, 3.0]))
    demo_obs = torch.zeros(6, 3, requires_grad=True)
    trainer = Losses(make(network, disc_grad_penalty=5.0))
    losses = []
    for weight in (0.0, 5.0, 0.5):
        trainer.discriminator.grad_penalty = weight
        info = trainer._disc_loss(column(0.0), network.eval_disc(demo_obs), demo_obs)
        losses.append(info["disc_loss"].item())
    assert losses[1] - losses[0] == pytest.approx(5.0 * 14.0)
    assert losses[2] - losses[0] == pytest.approx(0.5 * 14.0)


def test_gradient_penalty_of_a_linear_discriminator():
    network = Linear(torch.zeros(1, 3), torch.tensor([1.0, -2.0, 3.0]))
    demo_obs = torch.randn(6, 3, generator=torch.Generator().manual_seed(0)).requires_grad_(True)
    info = Losses(make(network))._disc_loss(column(0.0), network.eval_disc(demo_obs), demo_obs)
    # the gradient is v for every row: 1 + 4 + 9
    assert info["disc_grad_penalty"].item() == pytest.approx(14.0, rel=1e-6)


def smooth_case() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(4, 3)), rng.normal(size=4), rng.normal(size=(5, 3))


def slow_penalty(w: np.ndarray, v: np.ndarray, x: np.ndarray, step: float = 1e-5) -> float:
    """Mean squared gradient of v . tanh(W x) by central differences, in float64."""
    total = 0.0
    for row in x:
        for i in range(len(row)):
            shift = np.zeros_like(row)
            shift[i] = step
            high, low = (v @ np.tanh(w @ (row + s)) for s in (shift, -shift))
            total += ((high - low) / (2 * step)) ** 2
    return total / len(x)


def test_gradient_penalty_against_finite_differences():
    w, v, x = smooth_case()
    network = Smooth(torch.tensor(w, dtype=torch.float32), torch.tensor(v, dtype=torch.float32))
    demo_obs = torch.tensor(x, dtype=torch.float32, requires_grad=True)
    info = Losses(make(network))._disc_loss(column(0.0), network.eval_disc(demo_obs), demo_obs)
    # float32 against differences that are exact to 1e-9
    assert info["disc_grad_penalty"].item() == pytest.approx(slow_penalty(w, v, x), rel=1e-5)


def test_the_penalty_itself_has_gradients():
    """Without the graph of the first derivative the penalty would train nothing."""
    w, v, x = smooth_case()
    parameters = [torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in (w, v)]
    network = Smooth(*parameters)
    gradients = []
    for weight in (3.0, 0.0):
        demo_obs = torch.tensor(x, dtype=torch.float32, requires_grad=True)
        info = Losses(make(network, disc_grad_penalty=weight))._disc_loss(
            column(0.0), network.eval_disc(demo_obs), demo_obs
        )
        gradients.append(torch.autograd.grad(info["disc_loss"], parameters[1])[0].numpy())
    step = 1e-4
    expected = []
    for k in range(len(v)):
        shift = np.zeros_like(v)
        shift[k] = step
        difference = slow_penalty(w, v + shift, x) - slow_penalty(w, v - shift, x)
        expected.append(difference / (2 * step))
    # differences of differences: 1e-6 relative to penalties of about ten
    np.testing.assert_allclose(
        gradients[0] - gradients[1], 3.0 * np.array(expected), rtol=1e-3, atol=1e-3
    )


def test_the_penalty_is_taken_at_demonstrations_only():
    w, v, x = smooth_case()
    network = Smooth(torch.tensor(w, dtype=torch.float32), torch.tensor(v, dtype=torch.float32))
    penalties = set()
    for agent in (column(0.0), column(5.0, -3.0, 2.0)):
        demo_obs = torch.tensor(x, dtype=torch.float32, requires_grad=True)
        info = Losses(make(network))._disc_loss(agent, network.eval_disc(demo_obs), demo_obs)
        penalties.add(info["disc_grad_penalty"].item())
    assert len(penalties) == 1


# --- rows ---------------------------------------------------------------------------------------


def test_all_kinds_of_rows_are_evaluated_with_the_gradient_at_the_demonstrations():
    torch.manual_seed(0)
    network = StyleNetwork(3, (8,))
    agent, replay, demo = torch.randn(3, 4, 3)
    outputs = eval_discriminator(network, (agent,), (replay,), (demo,))
    for name, rows in (("agent", agent), ("agent_replay", replay), ("demo", demo)):
        torch.testing.assert_close(outputs[f"disc_{name}_logit"], network.eval_disc(rows))
    demo.requires_grad_()
    (expected,) = torch.autograd.grad(network.eval_disc(demo).sum(), demo)
    torch.testing.assert_close(outputs["disc_demo_gradient"], expected)


# --- keys -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"disc_reward": "least_square"}, ["disc_reward", "least_squares", "logistic"]),
        ({"disc_loss": "wgan"}, ["disc_loss", "bce", "least_squares"]),
        ({"amp_replay_keep_prob": 1.5}, ["amp_replay_keep_prob", "1.5"]),
        ({"amp_batch_size": 0}, ["amp_batch_size", "0"]),
        ({"disc_grad_penalty": -1}, ["disc_grad_penalty", "-1"]),
        ({"disc_coef": "high"}, ["disc_coef", "high"]),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_impossible_values_are_named_with_their_choices(changes, words):
    with pytest.raises(ConfigError) as caught:
        read_agent_params({**PARAMS, **changes}, AMPParams)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in ["train.params.config", *words]), message


@pytest.mark.parametrize("key", ["disc_coef", "amp_minibatch_size", "task_reward_w"])
def test_a_missing_key_is_named(key):
    with pytest.raises(ConfigError, match=rf"train\.params\.config\.{key}"):
        read_agent_params({k: v for k, v in PARAMS.items() if k != key}, AMPParams)


def test_defaults_and_foreign_keys():
    given = {k: v for k, v in PARAMS.items() if k != "normalize_amp_input"}
    params = read_agent_params({**given, "gamma": 0.99}, AMPParams)
    assert params.normalize_amp_input is True
    assert params.disc_reward is None
    assert params.disc_loss == "bce"


def test_how_much_is_seen_of_an_amp_observation():
    shape = AMPObsShape(size=1250, num_steps=10)
    for steps, size in ((None, 1250), (10, 1250), (2, 250), (1, 125)):
        params = read_agent_params({**PARAMS, "amp_obs_steps": steps}, AMPParams)
        assert disc_obs_size(shape, params) == size
    with pytest.raises(ConfigError, match=r"amp_obs_steps=11: .*at most 10, the control steps"):
        disc_obs_size(shape, read_agent_params({**PARAMS, "amp_obs_steps": 11}, AMPParams))


def test_what_is_not_seen_has_no_effect():
    network = Smooth(torch.randn(4, 3), torch.randn(4))
    params = read_agent_params({**PARAMS, "normalize_amp_input": True}, AMPParams)
    discriminator = StyleDiscriminator(network, 3, params, "logistic", "cpu")  # type: ignore[arg-type]
    whole = torch.randn(5, 2, 6)
    expected = discriminator.reward(whole[..., :3].clone())
    assert torch.equal(discriminator.reward(whole), expected)
