"""Tests of the returns of a point."""

import pytest
import torch

from benchmarks.goal_bounds import heading_return, location_return


def test_returns_of_a_point():
    """At once in the asked direction at the asked speed is the full reward, and rest is none."""
    torch.manual_seed(3)
    assert heading_return(1.55, rest_s=0.0) == pytest.approx(1.0, abs=1e-3)
    assert heading_return(1.55, rest_s=100.0) == 0.0
    # At 100 m/s each point is reached in the first step or the next.
    found, reached = location_return(100.0, rest_s=0.0)
    assert found == pytest.approx(1.0, abs=0.01)
    assert reached == 1.0
