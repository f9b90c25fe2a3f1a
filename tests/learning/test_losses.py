from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.learning import losses

GAMMA, TAU = 0.99, 0.95


def column(*numbers: float) -> torch.Tensor:
    """One environment, one value: (H, 1, 1)."""
    return torch.tensor(numbers).view(-1, 1, 1)


def test_advantages_of_three_steps_by_hand():
    advantages = losses.discount_values(
        torch.tensor([[0.0], [1.0], [0.0]]),
        column(0.2, 0.3, 0.1),
        column(1.0, 0.5, 0.0),
        column(0.3, 0.0, 0.4),
        GAMMA,
        TAU,
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
    advantages = losses.discount_values(
        torch.from_numpy(dones).to(dtype),
        torch.from_numpy(values),
        torch.from_numpy(rewards),
        torch.from_numpy(next_values),
        GAMMA,
        TAU,
    )
    expected = slow_advantages(dones, values, rewards, next_values, GAMMA, TAU)
    # float64 sums of at most seven terms
    np.testing.assert_allclose(advantages.numpy(), expected, rtol=0, atol=1e-12)


def test_advantages_leave_their_inputs_alone():
    dones, values = torch.zeros(2, 1), column(1.0, 2.0)
    rewards, next_values = column(3.0, 4.0), column(5.0, 6.0)
    inputs = (dones, values, rewards, next_values)
    copies = [x.clone() for x in inputs]
    losses.discount_values(dones, values, rewards, next_values, GAMMA, TAU)
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
    loss, outside = losses.actor_loss(
        new_neglogp + math.log(ratio), new_neglogp, torch.tensor([advantage]), True, 0.2
    )
    # neglogp is subtracted in float32: 1e-7 times the ratio
    assert loss.item() == pytest.approx(expected, abs=1e-6)
    assert outside.tolist() == [clipped]


def test_actor_loss_has_no_gradient_beyond_the_clip_range():
    new_neglogp = torch.tensor([0.0, 0.0], requires_grad=True)
    old_neglogp = torch.log(torch.tensor([1.5, 1.1]))
    loss, _ = losses.actor_loss(old_neglogp, new_neglogp, torch.ones(2), True, 0.2)
    loss.sum().backward()
    assert new_neglogp.grad is not None
    # d(-ratio) / d(neglogp) = ratio inside the range
    assert new_neglogp.grad.tolist() == pytest.approx([0.0, 1.1], abs=1e-6)


def test_without_ppo_the_actor_loss_is_the_plain_policy_gradient():
    neglogp = torch.tensor([2.0, -1.0])
    loss, clipped = losses.actor_loss(
        torch.tensor([2.0, 0.0]), neglogp, torch.tensor([3.0, 0.5]), False, 0.2
    )
    assert loss.tolist() == [6.0, -0.5]
    assert clipped.tolist() == [False, True]  # ratios 1 and e


def test_critic_loss_has_no_factor_of_a_half():
    loss = losses.critic_loss(
        torch.tensor([[9.0]]), torch.tensor([[0.5]]), torch.tensor([[2.0]]), 0.2, False
    )
    assert loss.tolist() == [[2.25]]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (1.0, 0.64),  # clipped to 0.2: the larger error counts, (1 - .2)^2
        (0.1, 0.81),  # within reach of the old value
        (-1.0, 4.0),  # clipped to -0.2 it would be 1.44, less than its own
    ],
)
def test_clipped_critic_loss_by_hand(value, expected):
    loss = losses.critic_loss(
        torch.tensor([[0.0]]), torch.tensor([[value]]), torch.tensor([[1.0]]), 0.2, True
    )
    assert loss.item() == pytest.approx(expected, abs=1e-6)


def test_bound_loss_begins_at_one():
    mu = torch.tensor([[1.5, -1.2, 0.3], [1.05, 1.0, -1.0], [-2.0, 2.0, 0.0]])
    # .5^2 + .2^2; .05^2; 1 + 1
    assert losses.bound_loss(mu).tolist() == pytest.approx([0.29, 0.0025, 2.0], abs=1e-6)


def test_bound_loss_with_another_bound():
    assert losses.bound_loss(torch.tensor([[1.5]]), 1.1).tolist() == pytest.approx([0.16])


def test_diversity_loss_by_hand():
    mu, other = torch.tensor([[0.2, 1.5]]), torch.tensor([[-0.3, 0.5]])
    # z . z' = 0.2
    latents = torch.tensor([[1.0, 0.0]])
    others = torch.tensor([[0.2, math.sqrt(0.96)]])
    # actions clamped to 1: (0.5^2 + 0.5^2) / 2 = 0.25; latents 0.5 - 0.1 = 0.4
    loss = losses.diversity_loss(mu, other, latents, others, 1.0)
    assert loss.item() == pytest.approx((1.0 - 0.25 / 0.40001) ** 2, rel=1e-5)
    assert loss.item() == pytest.approx(0.140637, abs=2e-5)


def test_moments_of_masked_rows():
    values, mask = torch.tensor([1.0, 2.0, 3.0, 10.0]), torch.tensor([1.0, 1.0, 1.0, 0.0])
    assert losses.normalize_masked(values, mask).tolist() == pytest.approx([-1.0, 0.0, 1.0, 8.0])
    for few in (torch.zeros(4), torch.tensor([0.0, 1.0, 0.0, 0.0])):
        assert torch.equal(losses.normalize_masked(values, few), values)


def test_alignment_and_uniformity_by_hand():
    x, y = torch.eye(2)
    found = torch.stack((x, x, x))
    others = torch.stack((x, y, -x))  # squared distances 0, 2, 4
    expected = torch.tensor([1.0, math.exp(-4), math.exp(-8)])
    torch.testing.assert_close(losses.uniformity_loss(found, others), expected)
    torch.testing.assert_close(losses.alignment_loss(found, others), torch.tensor([0.0, 2.0, 4.0]))
