from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.learning.common_agent import CommonAgent
from isaacgymenvs_lite.learning.gen_amp import GenAMPAgent
from isaacgymenvs_lite.learning.modules.running_mean_std import normalize_masked

GAMMA, TAU = 0.99, 0.95
AGENT: Any = SimpleNamespace(gamma=GAMMA, tau=TAU, ppo=True)


def column(*numbers: float) -> torch.Tensor:
    """One environment, one value: (H, 1, 1)."""
    return torch.tensor(numbers).view(-1, 1, 1)


def test_advantages_of_three_steps_by_hand():
    advantages = CommonAgent.discount_values(
        AGENT,
        torch.tensor([[0.0], [1.0], [0.0]]),
        column(0.2, 0.3, 0.1),
        column(1.0, 0.5, 0.0),
        column(0.3, 0.0, 0.4),
    )
    # delta = 1 + .99 * .3 - .2 = 1.097, .5 - .3 = .2, .99 * .4 - .1 = .296
    # A_2 = .296; A_1 = .2, the episode ended; A_0 = 1.097 + .99 * .95 * .2
    assert advantages.flatten().tolist() == pytest.approx([1.2851, 0.2, 0.296], abs=1e-6)


def slow_advantages(dones, values, rewards, next_values, gamma, tau) -> np.ndarray:
    """The sum of discounted temporal differences up to the end of the episode, term by term."""
    horizon, num_envs, num_values = rewards.shape
    result = np.zeros_like(rewards)
    for env in range(num_envs):
        for value in range(num_values):
            for start in range(horizon):
                for t in range(start, horizon):
                    delta = (
                        rewards[t, env, value]
                        + gamma * next_values[t, env, value]
                        - values[t, env, value]
                    )
                    result[start, env, value] += (gamma * tau) ** (t - start) * delta
                    if dones[t, env]:
                        break
    return result


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.bool, torch.float32])
def test_advantages_agree_with_a_slow_loop(dtype):
    rng = np.random.default_rng(0)
    shape = (7, 5, 2)
    values, rewards, next_values = (rng.normal(size=shape) for _ in range(3))
    dones = rng.random(shape[:2]) < 0.3
    advantages = CommonAgent.discount_values(
        AGENT,
        torch.from_numpy(dones).to(dtype),
        torch.from_numpy(values),
        torch.from_numpy(rewards),
        torch.from_numpy(next_values),
    )
    expected = slow_advantages(dones, values, rewards, next_values, GAMMA, TAU)
    # float64 sums of at most seven terms
    np.testing.assert_allclose(advantages.numpy(), expected, rtol=0, atol=1e-12)


def test_advantages_leave_their_inputs_alone():
    dones, values = torch.zeros(2, 1), column(1.0, 2.0)
    rewards, next_values = column(3.0, 4.0), column(5.0, 6.0)
    inputs = (dones, values, rewards, next_values)
    copies = [x.clone() for x in inputs]
    CommonAgent.discount_values(AGENT, dones, values, rewards, next_values)
    for before, after in zip(copies, inputs, strict=True):
        assert torch.equal(before, after)


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected", "clipped"),
    [
        (1.5, 1.0, -1.2, True),  # no more credit than at 1 + e_clip
        (1.5, -1.0, 1.5, True),  # blame is not limited
        (0.5, 1.0, -0.5, True),
        (0.5, -1.0, 0.8, True),
        (1.1, 2.0, -2.2, False),
        (1.0, 3.0, -3.0, False),
    ],
)
def test_actor_loss_by_hand(ratio, advantage, expected, clipped):
    new_neglogp = torch.tensor([0.7])
    found = CommonAgent._actor_loss(
        AGENT, new_neglogp + math.log(ratio), new_neglogp, torch.tensor([advantage]), 0.2
    )
    # neglogp is subtracted in float32: 1e-7 times the ratio
    assert found["actor_loss"].item() == pytest.approx(expected, abs=1e-6)
    assert found["actor_clipped"].tolist() == [clipped]


def test_actor_loss_has_no_gradient_beyond_the_clip_range():
    new_neglogp = torch.tensor([0.0, 0.0], requires_grad=True)
    old_neglogp = torch.log(torch.tensor([1.5, 1.1]))
    found = CommonAgent._actor_loss(AGENT, old_neglogp, new_neglogp, torch.ones(2), 0.2)
    found["actor_loss"].sum().backward()
    assert new_neglogp.grad is not None
    # d(-ratio) / d(neglogp) = ratio inside the range
    assert new_neglogp.grad.tolist() == pytest.approx([0.0, 1.1], abs=1e-6)


def test_without_ppo_the_actor_loss_is_the_plain_policy_gradient():
    neglogp = torch.tensor([2.0, -1.0])
    agent: Any = SimpleNamespace(ppo=False)
    found = CommonAgent._actor_loss(
        agent, torch.tensor([2.0, 0.0]), neglogp, torch.tensor([3.0, 0.5]), 0.2
    )
    assert found["actor_loss"].tolist() == [6.0, -0.5]
    assert found["actor_clipped"].tolist() == [False, True]  # ratios 1 and e


def test_critic_loss_has_no_factor_of_a_half():
    old, value, target = (torch.tensor([[number]]) for number in (9.0, 0.5, 2.0))
    found = CommonAgent._critic_loss(AGENT, old, value, 0.2, target, False)
    assert found["critic_loss"].tolist() == [[2.25]]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (1.0, 0.64),  # clipped to 0.2: the larger error counts, (1 - .2)^2
        (0.1, 0.81),  # within reach of the old value
        (-1.0, 4.0),  # clipped to -0.2 it would be 1.44, less than its own
    ],
)
def test_clipped_critic_loss_by_hand(value, expected):
    old, new, target = (torch.tensor([[number]]) for number in (0.0, value, 1.0))
    found = CommonAgent._critic_loss(AGENT, old, new, 0.2, target, True)
    assert found["critic_loss"].item() == pytest.approx(expected, abs=1e-6)


def test_bound_loss_begins_at_one():
    mu = torch.tensor([[1.5, -1.2, 0.3], [1.05, 1.0, -1.0], [-2.0, 2.0, 0.0]])
    # .5^2 + .2^2; .05^2; 1 + 1
    assert CommonAgent.bound_loss(AGENT, mu).tolist() == pytest.approx(
        [0.29, 0.0025, 2.0], abs=1e-6
    )


def test_diversity_loss_by_hand():
    mu, other = torch.tensor([[0.2, 1.5]]), torch.tensor([[-0.3, 0.5]])
    # z . z' = 0.2
    latents = torch.tensor([[1.0, 0.0]])
    others = torch.tensor([[0.2, math.sqrt(0.96)]])
    # actions clamped to 1: (0.5^2 + 0.5^2) / 2 = 0.25; latents 0.5 - 0.1 = 0.4
    agent: Any = SimpleNamespace(
        _eval_actor=lambda obs, new_latents: (other, None),
        _amp=SimpleNamespace(amp_diversity_tar=1.0),
    )
    loss = GenAMPAgent._diversity_loss(agent, torch.zeros(1, 4), mu, latents, others)
    assert loss.item() == pytest.approx((1.0 - 0.25 / 0.40001) ** 2, rel=1e-5)
    assert loss.item() == pytest.approx(0.140637, abs=2e-5)


def test_moments_of_masked_rows():
    values, mask = torch.tensor([1.0, 2.0, 3.0, 10.0]), torch.tensor([1.0, 1.0, 1.0, 0.0])
    assert normalize_masked(values, mask).tolist() == pytest.approx([-1.0, 0.0, 1.0, 8.0])
    for few in (torch.zeros(4), torch.tensor([0.0, 1.0, 0.0, 0.0])):
        assert torch.equal(normalize_masked(values, few), values)


def test_alignment_and_uniformity_by_hand():
    x, y = torch.eye(2)
    network = SimpleNamespace(eval_enc=lambda rows: rows)
    agent: Any = SimpleNamespace(
        model=SimpleNamespace(a2c_network=network),
        _amp=SimpleNamespace(enc_alignment_coef=2.0, enc_uniformity_coef=3.0),
    )
    # squared distances to the near moments 0, 2, 4; to the others 0, 2, 4
    triples = torch.stack([torch.stack((x, other, other)) for other in (x, y, -x)])
    terms = GenAMPAgent._clip_encoding_losses(agent, {"demo_triples": triples})
    weight, alignment = terms["enc_alignment_loss"]
    assert (weight, alignment.item()) == (2.0, pytest.approx(2.0))
    weight, uniformity = terms["enc_uniformity_loss"]
    expected = (1.0 + math.exp(-4) + math.exp(-8)) / 3
    assert (weight, uniformity.item()) == (3.0, pytest.approx(expected))


def test_the_first_entries_of_latents_become_commands():
    agent: Any = SimpleNamespace(
        model=SimpleNamespace(a2c_network=SimpleNamespace(eval_enc=lambda rows: rows)),
        _amp=SimpleNamespace(
            enc_alignment_coef=0.0, enc_uniformity_coef=0.0, enc_command_coef=20.0
        ),
    )
    rows = {
        "demo_triples": torch.zeros(2, 3, 3),
        "commanded_demos": torch.tensor([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]]),
        "commands": torch.tensor([[0.3, 0.4], [0.0, 0.5]]),
    }
    weight, loss = GenAMPAgent._clip_encoding_losses(agent, rows)["enc_command_loss"]
    # (0.3^2 + 0.4^2 + 0.5^2) / 2; the third entry of a latent is free
    assert (weight, loss.item()) == (20.0, pytest.approx(0.25))
