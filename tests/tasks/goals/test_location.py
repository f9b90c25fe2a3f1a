"""The goal `location`: numbers of the specification, and what counts near the point."""

from __future__ import annotations

import math

import pytest
import torch

from isaacgymenvs_lite.tasks.goals.location import (
    compute_location_observations,
    compute_location_reward,
)

# The specification prints six digits.
ATOL = 2e-6


def test_numbers_of_the_specification(case) -> None:
    goal = torch.tensor([[3.0, 4.0]])
    found = compute_location_reward(case.pos, case.prev_pos, case.rot, goal, 1.0, case.dt)
    assert float(found) == pytest.approx(0.472831, abs=ATOL)
    seen = compute_location_observations(case.root_states, goal)
    expected = torch.tensor([[2.793050, 0.445949]])
    torch.testing.assert_close(seen, expected, rtol=0, atol=ATOL)


def test_near_the_point_speed_and_facing_do_not_count(case) -> None:
    for distance, is_near in [(0.70, True), (0.72, False)]:
        # It stands with its back to the point.
        pos = torch.tensor([[0.0, 0.0, 0.9]])
        rot = torch.tensor([[0.0, 0.0, 1.0, 0.0]])
        goal = torch.tensor([[distance, 0.0]])
        found = float(compute_location_reward(pos, pos, rot, goal, 1.0, case.dt))
        place = 0.5 * math.exp(-0.5 * distance**2)
        assert found == pytest.approx(place + 0.5 if is_near else place, abs=1e-6)


def test_standing_on_the_point_is_no_division_by_zero(case) -> None:
    goal = case.pos[:, :2].clone()
    found = compute_location_reward(case.pos, case.pos, case.rot, goal, 1.0, case.dt)
    assert float(found) == pytest.approx(1.0)


def test_faster_than_wanted_is_no_mistake(case) -> None:
    pos = torch.tensor([[0.0, 0.0, 0.9]])
    rot = torch.tensor([[0.0, 0.0, 0.0, 1.0]])
    goal = torch.tensor([[5.0, 0.0]])
    prev = torch.tensor([[-3.0 * case.dt, 0.0, 0.9]])
    found = float(compute_location_reward(pos, prev, rot, goal, 1.0, case.dt))
    assert found == pytest.approx(0.5 * math.exp(-12.5) + 0.5, abs=1e-6)
