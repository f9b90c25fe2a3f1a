"""A short form of the benchmark: what it finds must be the same, however few the kills."""

from __future__ import annotations

import pytest

from benchmarks.torture import torture


@pytest.mark.parametrize(("name", "kills"), [("PPO", 4), ("AMP", 2)])
def test_kills_cost_nothing(name, kills, tmp_path):
    result = torture(name, kills, tmp_path, seed=3)
    assert result.failures == []
    assert (result.kills, result.resumed) == (kills, kills)
    assert result.lost == 0
    assert result.writing > 0
