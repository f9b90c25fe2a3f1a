"""The goal `strike`: numbers of the specification, and when it is missed."""

from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.tasks.goals.strike import (
    compute_strike_failures,
    compute_strike_observations,
    compute_strike_reward,
)

# The specification prints six digits.
ATOL = 2e-6


def test_numbers_of_the_specification(case) -> None:
    place = torch.tensor([[2.0, 3.0, 0.9]])
    found = compute_strike_reward(place, case.rot, case.pos, case.prev_pos, case.dt)
    assert float(found) == pytest.approx(0.428082, abs=ATOL)
    velocities = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])
    seen = compute_strike_observations(
        case.root_states, torch.cat((place, case.rot, velocities), dim=-1)
    )
    seen_at, turn = (
        [1.396525, 0.222975, 0.9],
        [0.896963, 0, 0.442105, -0.441008, -0.070413, 0.894737],
    )
    moving = [0.198330, 0.103272, 0.3, 0.617288, 0.170165, 0.6]
    expected = torch.tensor([[*seen_at, *turn, *moving]])
    torch.testing.assert_close(seen, expected, rtol=0, atol=ATOL)


def test_a_lying_box_earns_everything(case) -> None:
    lying = torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]])
    place = torch.tensor([[2.0, 3.0, 0.2]])
    assert float(compute_strike_reward(place, lying, case.pos, case.pos, case.dt)) == 1.0


def test_only_a_touched_box_and_a_body_that_must_not_touch_fail() -> None:
    for target, body, force, failed in [
        ([2.0, 0.0, 0.0], 2, -1.5, True),
        ([0.0, -2.0, 0.0], 2, 1.5, True),
        ([0.0, 0.0, 9.0], 2, 1.5, False),  # the box stands on the ground
        ([2.0, 0.0, 0.0], 1, 1.5, False),  # an allowed body
        ([2.0, 0.0, 0.0], 2, 0.9, False),
    ]:
        forces = torch.zeros(1, 4, 3)
        forces[0, body, 1] = force
        allowed = torch.tensor([0, 1])
        found = compute_strike_failures(torch.tensor([target]), forces, allowed)
        assert found.tolist() == [failed]
