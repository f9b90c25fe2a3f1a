"""The goal `heading`: numbers of the specification, and what the reward punishes."""

from __future__ import annotations

import math

import pytest
import torch

from isaacgymenvs_lite.tasks.goals.heading import (
    compute_heading_observations,
    compute_heading_reward,
)

# The specification prints six digits.
ATOL = 2e-6
EAST = torch.tensor([[1.0, 0.0]])


def direction(angle: float) -> torch.Tensor:
    return torch.tensor([[math.cos(angle), math.sin(angle)]])


def reward(velocity, rot=(0.0, 0.0, 0.0, 1.0)) -> float:
    dt = 0.5
    pos = torch.tensor([[3.0, 4.0, 0.9]])
    prev = pos - dt * torch.tensor([[*velocity, 0.0]])
    rot = torch.tensor([rot])
    return float(compute_heading_reward(pos, prev, rot, EAST, torch.tensor([1.5]), EAST, dt))


def test_observation_of_the_specification(case) -> None:
    found = compute_heading_observations(
        case.root_states, direction(0.5), torch.tensor([1.5]), EAST
    )
    expected = [[0.991937, -0.126729, 1.5, 0.809750, -0.586775]]
    torch.testing.assert_close(found, torch.tensor(expected), rtol=0, atol=ATOL)


def test_reward_of_the_specification(case) -> None:
    found = compute_heading_reward(
        case.pos, case.prev_pos, case.rot, direction(0.5), torch.tensor([1.5]), EAST, case.dt
    )
    assert float(found) == pytest.approx(0.888913, abs=ATOL)


def test_what_is_paid() -> None:
    assert reward((1.5, 0.0)) == pytest.approx(1.0)  # as wanted
    assert reward((-0.1, 0.0)) == pytest.approx(0.3)  # backward: the facing alone
    assert reward((1.5, 0.0), rot=(0.0, 0.0, 1.0, 0.0)) == pytest.approx(0.7)  # faces away
    # Sideways: 0.7 exp(-0.25 * 0.1 * 2^2) + 0.3
    assert reward((1.5, 2.0)) == pytest.approx(0.7 * math.exp(-0.1) + 0.3)
