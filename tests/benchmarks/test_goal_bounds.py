"""What a point that walks ahead earns of a goal, against numbers that follow from the rewards."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from benchmarks.goal_bounds import heading_reward, location_reward


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(1)


def test_who_turns_at_once_faces_where_both_together_earn_most():
    """The formula of the reward, over directions to go (g), to face (f) and to walk (w)."""
    g, f, w = (index * (2 * np.pi / 60) for index in np.ogrid[:60, :60, :60])
    along = 1.55 * np.cos(w - g)
    across = 1.55 * np.sin(w - g) * (np.cos(g) - np.sin(g))  # the sum of its components, as ASE
    error = (1.55 - along) ** 2 + 0.1 * across**2
    direction = np.where(along > 0, np.exp(-0.25 * error), 0)
    reward = 0.7 * direction + 0.3 * np.maximum(np.cos(w - f), 0)
    assert heading_reward(1.55, math.inf) == pytest.approx(reward.max(axis=2).mean(), abs=0.005)


def test_turning_takes_time():
    assert heading_reward(1.55, 60.0) < heading_reward(1.55, 180.0) < heading_reward(1.55, math.inf)


def test_who_rests_earns_the_facing_of_location_and_the_points_that_are_near():
    # Of a square of 20 m the Gaussian covers 2 pi m^2, and the circle of arrival pi / 2.
    near = 0.5 * 2 * math.pi / 400 + 0.4 * (math.pi / 2) / 400
    assert location_reward(0.0, math.inf) == pytest.approx(0.1 + near, abs=0.003)


def test_who_runs_arrives_at_more_points():
    assert location_reward(1.0, 180.0) + 0.05 < location_reward(2.8, 180.0) < 1.0
