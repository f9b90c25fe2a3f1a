from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.learning.skills.latents import ClipLatents, sample_similar_rows

DIM = 4


def read(amp_obs: Tensor) -> Tensor:
    """A reading that shows which row it is of: (cos a, sin a, 0, 0) of the row's one number."""
    angle = amp_obs[:, 0]
    return torch.stack((angle.cos(), angle.sin(), 0 * angle, 0 * angle), dim=-1)


def fetch(n: int) -> Tensor:
    return torch.linspace(0.1, 3.0, n).unsqueeze(-1)


def clip_latents(share: float) -> ClipLatents:
    torch.manual_seed(0)
    return ClipLatents(share, DIM, read, fetch)


def of_clips(latents: Tensor) -> Tensor:
    return (latents[:, 2:] == 0).all(dim=-1)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_share_of_the_latents_that_are_of_clips(share):
    drawn = clip_latents(share).draw(2000)
    torch.testing.assert_close(drawn.norm(dim=-1), torch.ones(2000))
    # binomial: standard error 0.01
    assert of_clips(drawn).float().mean().item() == pytest.approx(share, abs=0.04 * (0 < share < 1))


def test_an_episode_has_the_latent_of_its_own_start():
    starts = fetch(500)
    latents, of_starts = clip_latents(0.5).for_starts(starts)
    own = of_clips(latents)
    assert 200 < own.sum() < 300
    torch.testing.assert_close(latents[own], read(starts)[own])
    assert own.nonzero().flatten().tolist() == of_starts.tolist()


def test_without_a_share_the_random_numbers_are_those_of_random_latents():
    drawn = clip_latents(0.0).draw(5)
    torch.manual_seed(0)
    expected = torch.nn.functional.normalize(torch.randn(5, DIM), dim=-1)
    assert torch.equal(drawn, expected)


def test_neighbours_are_drawn_by_the_density_of_von_mises_and_fisher():
    torch.manual_seed(0)
    found = read(torch.tensor([[0.0], [1.0], [2.0]]))
    latent = read(torch.tensor([[0.5]])).expand(30_000, -1)
    picked = sample_similar_rows(latent, found, sharpness=2.0)
    weights = torch.tensor([math.exp(2.0 * math.cos(0.5 - a)) for a in (0.0, 1.0, 2.0)])
    shares = torch.bincount(picked, minlength=3) / 30_000
    # binomial: standard error below 0.003
    torch.testing.assert_close(shares, weights / weights.sum(), rtol=0, atol=0.015)
    assert (sample_similar_rows(latent[:50], found, sharpness=1e4) < 2).all()
