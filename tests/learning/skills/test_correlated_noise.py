from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.learning.hrl_continuous import CorrelatedNoise


def run(correlation: float, steps: int, envs: int = 2000) -> tuple[torch.Tensor, ...]:
    """Noise (steps, envs, 2) in standard deviations, its -log p, and the policy's spread."""
    generator = torch.Generator().manual_seed(0)
    process = CorrelatedNoise(correlation)
    mus = torch.tensor([0.3, -0.2]).repeat(envs, 1)
    sigmas = torch.tensor([0.1, 0.5]).repeat(envs, 1)
    noise, neglogp = [], []
    for _ in range(steps):
        actions = mus + sigmas * torch.randn(envs, 2, generator=generator)
        actions, logp = process.apply(actions, mus, sigmas)
        noise.append((actions - mus) / sigmas)
        neglogp.append(logp)
    return torch.stack(noise), torch.stack(neglogp), sigmas


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_noise_lasts_and_each_sample_is_standard_normal(correlation):
    noise, _, _ = run(correlation, steps=8)
    for step in (0, 7):
        # 4000 numbers: standard errors 0.016 and 0.011
        assert noise[step].mean().item() == pytest.approx(0.0, abs=0.07)
        assert noise[step].std().item() == pytest.approx(1.0, abs=0.05)
    for apart in (1, 3):
        found = (noise[7] * noise[7 - apart]).mean().item()
        assert found == pytest.approx(correlation**apart, abs=0.07)


def test_the_probability_is_that_of_the_action_under_the_policy():
    noise, neglogp, sigmas = run(0.9, steps=3, envs=5)
    normal = torch.distributions.Normal(torch.zeros(5, 2), sigmas)
    expected = -normal.log_prob(noise[2] * sigmas).sum(dim=-1)
    torch.testing.assert_close(neglogp[2], expected, rtol=1e-4, atol=1e-4)
