"""Losses and advantages as pure functions: PPO's as in IsaacGymEnvs, and the losses of skills.

PPO's differ from rl_games': no factor 0.5 on the critic, a bound at 1.0 instead of 1.1, and
advantages that bootstrap with the value of the state *after* each step (docs/amp.md has the list).
"""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.distributed.moments import normalize_jointly


def actor_loss(
    old_neglogp: Tensor, new_neglogp: Tensor, advantage: Tensor, ppo: bool, e_clip: float
) -> tuple[Tensor, Tensor]:
    """Return the policy loss (M,) and whether each ratio was outside the clip range (M,) bool.

    PPO's clipped surrogate (Schulman et al. 2017, eq. 7), negated; with `ppo` False the plain
    policy gradient neglogp * advantage.
    """
    ratio = torch.exp(old_neglogp - new_neglogp)
    clipped = (ratio - 1.0).abs() > e_clip
    if not ppo:
        return new_neglogp * advantage, clipped
    surrogate = advantage * ratio
    surrogate_clipped = advantage * ratio.clamp(1.0 - e_clip, 1.0 + e_clip)
    return torch.max(-surrogate, -surrogate_clipped), clipped


def critic_loss(
    old_values: Tensor, values: Tensor, returns: Tensor, e_clip: float, clip_value: bool
) -> Tensor:
    """Return the squared value errors (M, values); `clip_value` clips around the old values."""
    loss = (returns - values) ** 2
    if not clip_value:
        return loss
    values_clipped = old_values + (values - old_values).clamp(-e_clip, e_clip)
    return torch.max(loss, (returns - values_clipped) ** 2)


def bound_loss(mu: Tensor, soft_bound: float = 1.0) -> Tensor:
    """Return (M,) the squared amount by which mean actions mu (M, A) leave +-soft_bound."""
    excess = mu.abs().sub(soft_bound).clamp(min=0.0)
    return (excess * excess).sum(dim=-1)


def discount_values(
    dones: Tensor, values: Tensor, rewards: Tensor, next_values: Tensor, gamma: float, tau: float
) -> Tensor:
    """Return generalised advantages (H, N, values) (Schulman et al. 2015, eq. 16).

    delta_t = r_t + gamma next_V_t - V_t;  A_t = delta_t + gamma tau (1 - done_t) A_{t+1}.

    Args:
        dones: (H, N) whether the episode ended in this step.
        values: (H, N, values) of the state before each step.
        rewards: (H, N, values).
        next_values: (H, N, values) of the state after each step, zero after failures.
        gamma: discount.
        tau: lambda of the estimator.
    """
    advantages = torch.empty_like(rewards)
    not_done = (1.0 - dones.to(rewards.dtype)).unsqueeze(-1)
    deltas = rewards + gamma * next_values - values
    running = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        running = deltas[t] + gamma * tau * not_done[t] * running
        advantages[t] = running
    return advantages


def input_gradient(outputs: Tensor, inputs: Tensor) -> Tensor:
    """Return (K, F) the gradients of outputs (K, 1) by inputs (K, F), differentiable themselves.

    For gradient penalties; each output depends on the input of its own row only.
    """
    (gradient,) = torch.autograd.grad(outputs, inputs, torch.ones_like(outputs), create_graph=True)
    return gradient


def diversity_loss(
    mu: Tensor, other_mu: Tensor, latents: Tensor, other_latents: Tensor, target: float
) -> Tensor:
    """Return (M,) the squared error of how different the actions under two latents are.

    (target - |a - a'|^2 / A / (0.5 - 0.5 z . z' + 1e-5))^2 with actions clamped to +-1 (ASE, Peng
    et al. 2022, eq. 14, in its published code's form).

    Args:
        mu: (M, A) mean actions under `latents`.
        other_mu: (M, A) mean actions of the same observations under `other_latents`.
        latents: (M, Z) unit vectors.
        other_latents: (M, Z) unit vectors.
        target: of the quotient.
    """
    action_distance = (mu.clamp(-1.0, 1.0) - other_mu.clamp(-1.0, 1.0)).square().mean(dim=-1)
    latent_distance = 0.5 - 0.5 * (latents * other_latents).sum(dim=-1)
    return (target - action_distance / (latent_distance + 1e-5)).square()


def normalize_advantages(advantages: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return advantages (n,) normalised by mean and standard deviation of the rows that count.

    Of several processes that train together the rows of all count.

    Args:
        advantages: of this process.
        mask: (n,) 1 where a row counts; None: all do.
    """
    if current_group().size > 1:
        return normalize_jointly(advantages, torch.ones_like(advantages) if mask is None else mask)
    if mask is not None:
        return normalize_masked(advantages, mask)
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def normalize_masked(values: Tensor, mask: Tensor) -> Tensor:
    """Return values (n,) normalised by mean and standard deviation of the rows of mask (n,) 1.

    The variance is unbiased; with fewer than two such rows the values are returned unchanged.
    """
    count = mask.sum()
    if count < 2:
        return values
    mean = (mask * values).sum() / count
    variance = ((mask * values).square().sum() / count - mean.square()) * count / (count - 1)
    return (values - mean) / (variance.clamp(min=0.0).sqrt() + 1e-8)


def alignment_loss(found: Tensor, near: Tensor) -> Tensor:
    """Return (n,) |q - q'|^2 of unit vectors (n, Z) that should be equal.

    Wang and Isola 2020 (arXiv 2005.10242), eq. 1.
    """
    return (found - near).square().sum(dim=-1)


def uniformity_loss(found: Tensor, others: Tensor) -> Tensor:
    """Return (n,) how near unit vectors (n, Z) are to others (n, Z): exp(-2 |q - q'|^2).

    Wang and Isola 2020, eq. 2, without the logarithm of the mean; it spreads them over the sphere.
    """
    return torch.exp(-2.0 * (found - others).square().sum(dim=-1))
