"""Episodes start more often where the policy fails soon."""

from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.tasks.amp.reference_motions import AdaptiveStarts

LENGTHS_S = torch.tensor([0.5, 1.0])
WEIGHTS = torch.tensor([0.25, 0.75], dtype=torch.float64)
SOON = 45


def starts() -> AdaptiveStarts:
    return AdaptiveStarts(LENGTHS_S, WEIGHTS, SOON)


def shares(adaptive: AdaptiveStarts) -> torch.Tensor:
    """Share of each bin among the starts that are drawn."""
    torch.manual_seed(3)
    return torch.bincount(adaptive.bins_of(*adaptive.draw(40_000)), minlength=15) / 40_000


def failing(adaptive: AdaptiveStarts, bins: list[int]) -> None:
    """Count as many episodes from each bin, of which those from `bins` fail at once."""
    every = torch.arange(15).repeat(500)
    adaptive.count(every, torch.where(torch.isin(every, torch.tensor(bins)), 10, 300), every >= 0)


def test_at_first_they_are_drawn_by_weight_and_evenly():
    expected = torch.cat((torch.full((5,), 0.25 / 5), torch.full((10,), 0.75 / 10)))
    # Standard deviation sqrt(0.075 / 40000) = 0.0014; five of them.
    torch.testing.assert_close(shares(starts()), expected, atol=0.007, rtol=0.0)


def test_where_it_fails_it_starts():
    adaptive = starts()
    failing(adaptive, [2, 9])
    drawn = shares(adaptive)
    assert drawn[2] + drawn[9] > 0.99
    # By weight of the clips and length of the bins: 0.05 to 0.075.
    assert (drawn[2] / drawn[9]).item() == pytest.approx(0.05 / 0.075, rel=0.1)
    failing(adaptive, [4])  # the others have been learned
    assert shares(adaptive)[4] > 0.99


def test_a_late_failure_and_one_that_was_cut_off_are_no_failures_of_the_start():
    adaptive = starts()
    before = adaptive.failure_rate.clone()
    bins, soon = torch.full((100,), 7), torch.full((100,), SOON - 1)
    adaptive.count(bins, soon, torch.zeros(100, dtype=torch.bool))  # cut off
    assert torch.equal(adaptive.failure_rate, before)
    adaptive.count(bins, soon + 2, torch.ones(100, dtype=torch.bool))  # fell later
    assert adaptive.failure_rate[7] < 0.1
    assert torch.equal(adaptive.failure_rate[:7], before[:7])
