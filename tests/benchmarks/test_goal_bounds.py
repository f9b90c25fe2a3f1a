"""Tests of the returns of a point."""

import math

import pytest
import torch

from benchmarks.goal_bounds import heading_return, location_return


def test_returns_of_a_point():
    """A point that always moves as asked earns 1; facing anywhere earns 0.3 times 1 / pi."""
    torch.manual_seed(3)
    assert heading_return(1.55, pause_s=0.0) == pytest.approx(1.0, abs=1e-3)
    # 1 / pi is the mean of the positive part of a cosine; the standard error is 1e-4.
    assert heading_return(1.55, pause_s=100.0) == pytest.approx(0.3 / math.pi, abs=1e-3)
    # A speed of 100 m/s reaches each goal within five steps.
    found, reached = location_return(100.0, pause_s=0.0)
    assert found == pytest.approx(1.0, abs=0.01)
    assert reached == 1.0
