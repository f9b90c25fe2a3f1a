"""What a point that walks ahead earns of a goal, against numbers that follow from the rewards."""

from __future__ import annotations

import math

import pytest
import torch

from benchmarks.goal_bounds import heading_bound, location_bound


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(1)


def test_who_turns_at_once_misses_of_heading_but_the_other_facing():
    # The direction earns 0.7, a random facing 0.3 times the mean of max(cos, 0).
    assert heading_bound(1.55, math.inf) == pytest.approx(0.7 + 0.3 / math.pi, abs=0.005)


def test_turning_takes_time():
    assert heading_bound(1.55, 60.0) < heading_bound(1.55, 180.0) < heading_bound(1.55, math.inf)


def test_who_stands_earns_the_facing_of_location_and_the_points_that_are_near():
    # Of a square of 20 m the Gaussian covers 2 pi m^2, and the circle of arrival pi / 2.
    near = 0.5 * 2 * math.pi / 400 + 0.4 * (math.pi / 2) / 400
    assert location_bound(0.0, math.inf) == pytest.approx(0.1 + near, abs=0.003)


def test_who_runs_arrives_at_more_points():
    assert location_bound(1.0, 180.0) + 0.05 < location_bound(2.8, 180.0) < 1.0
