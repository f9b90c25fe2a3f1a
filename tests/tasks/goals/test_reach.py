"""The goal `reach`: numbers of the specification."""

from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.tasks.goals.reach import (
    compute_reach_observations,
    compute_reach_reward,
)

# The specification prints six digits.
ATOL = 2e-6


def test_numbers_of_the_specification(case) -> None:
    body, goal = torch.tensor([[0.5, 0.2, 1.0]]), torch.tensor([[0.6, 0.0, 1.2]])
    assert float(compute_reach_reward(body, goal)) == pytest.approx(0.697676, abs=ATOL)
    seen = compute_reach_observations(case.root_states, goal)
    expected = torch.tensor([[0.485850, -0.352065, 1.2]])
    torch.testing.assert_close(seen, expected, rtol=0, atol=ATOL)
