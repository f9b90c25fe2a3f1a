"""Distributions of draws and of noise, against their moments."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.tasks.randomization.randomizer import Noise, draw
from isaacgymenvs_lite.tasks.randomization.settings import AttributeSettings, NoiseSettings

N = 40_000
# Five standard errors of a mean of N numbers of unit deviation.
ERROR = 5.0 / math.sqrt(N)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def _settings(**changes: Any) -> AttributeSettings:
    given = {"range": (0.5, 1.5), "operation": "scaling", "distribution": "uniform", **changes}
    return AttributeSettings(**given)


def test_a_uniform_draw_fills_its_range() -> None:
    drawn = draw(_settings(), 0, (N,))
    assert drawn.min() >= 0.5
    assert drawn.max() <= 1.5
    assert drawn.mean().item() == pytest.approx(1.0, abs=ERROR)
    assert drawn.std().item() == pytest.approx(1.0 / math.sqrt(12.0), abs=ERROR)


def test_the_second_number_of_a_gaussian_is_its_deviation() -> None:
    drawn = draw(
        _settings(distribution="gaussian", operation="additive", range=(1.0, 0.4)), 0, (N,)
    )
    assert drawn.mean().item() == pytest.approx(1.0, abs=ERROR)
    assert drawn.std().item() == pytest.approx(0.4, abs=ERROR)


def test_a_loguniform_draw_is_uniform_in_the_logarithm() -> None:
    drawn = draw(_settings(distribution="loguniform", range=(0.3, 3.0)), 0, (N,)).log()
    assert drawn.min() >= math.log(0.3)
    assert drawn.mean().item() == pytest.approx(math.log(0.9) / 2.0, abs=ERROR)


def test_a_schedule_leads_from_nothing_to_the_whole() -> None:
    half = _settings(schedule="linear", schedule_steps=10)
    assert (draw(half, 0, (5,)) == 1.0).all()
    drawn = draw(half, 5, (N,))  # U(0.75, 1.25)
    assert drawn.min() >= 0.75
    assert drawn.max() <= 1.25
    additive = _settings(
        operation="additive", distribution="gaussian", schedule="linear", schedule_steps=10
    )
    assert (draw(additive, 0, (5,)) == 0.0).all()


def test_buckets_hold_few_values_and_no_draw_leaves_them() -> None:
    drawn = draw(_settings(num_buckets=4), 0, (N,))
    assert sorted(set(drawn.tolist())) == [0.5, 0.75, 1.0, 1.25]
    # Gaussian: the grid spans the mean +- 2 sqrt(0.4), and draws below it stay at its low end.
    drawn = draw(_settings(distribution="gaussian", range=(1.0, 0.4), num_buckets=2), 0, (N,))
    low, high = 1.0 - 2.0 * math.sqrt(0.4), 1.0
    assert {round(v, 6) for v in set(drawn.tolist())} == {round(low, 6), high}


def test_gaussian_noise_has_a_fresh_and_a_held_part() -> None:
    noise = Noise(
        NoiseSettings(
            range=(0.5, 0.2),
            range_correlated=(0.25, 2.0),
            operation="additive",
            distribution="gaussian",
        )
    )
    first, second = (noise(torch.zeros(N, 1)) for _ in range(2))
    assert first.mean().item() == pytest.approx(0.75, abs=2.1 * ERROR)
    assert first.std().item() == pytest.approx(math.hypot(0.2, 2.0), abs=2.1 * ERROR)
    # What differs from one call to the next is the fresh part alone.
    assert (first - second).std().item() == pytest.approx(0.2 * math.sqrt(2.0), abs=ERROR)
    noise.refresh(0)
    assert (noise(torch.zeros(N, 1)) - first).std() > 2.0


def test_uniform_noise_adds_a_gaussian_held_part() -> None:
    noise = Noise(
        NoiseSettings(
            range=(-0.1, 0.3),
            range_correlated=(0.0, 1.0),
            operation="additive",
            distribution="uniform",
        )
    )
    first, second = (noise(torch.zeros(N, 1)) for _ in range(2))
    assert (first - second).abs().max() <= 0.4
    assert first.mean().item() == pytest.approx(0.1, abs=1.1 * ERROR)
    assert first.std().item() == pytest.approx(math.hypot(1.0, 0.4 / math.sqrt(12.0)), abs=ERROR)


def test_scaling_noise_multiplies_and_begins_with_one() -> None:
    noise = Noise(
        NoiseSettings(
            range=(0.9, 1.1),
            operation="scaling",
            distribution="uniform",
            schedule="constant",
            schedule_steps=5,
        )
    )
    values = torch.full((N, 1), 3.0)
    noise.refresh(5)
    noisy = noise(values)
    assert noisy.min() >= 2.7 - 1e-5
    assert noisy.max() <= 3.3 + 1e-5
    assert noisy.mean().item() == pytest.approx(3.0, abs=3.0 * ERROR)
