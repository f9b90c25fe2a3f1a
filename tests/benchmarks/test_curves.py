from __future__ import annotations

import numpy as np
import pytest

from benchmarks.curves import (
    draw,
    markdown_table,
    median_line,
)
from benchmarks.learning_curve import read_learning_curve


@pytest.fixture
def two_seeds(write_events, tmp_path):
    """Return curves of two seeds; seed 1 reaches 280 in its third minute, seed 2 never does."""
    for seed, lengths in ((1, [10.0, 100.0, 280.0, 290.0]), (2, [10.0, 20.0, 30.0])):
        folder = tmp_path / f"walk_seed{seed}"
        write_events(folder / "summaries", lengths, poses={1: 0.1 * seed, 2: 0.05 * seed})
        (folder / "config.yaml").write_text(f"seed: {seed}\n")
    folders = sorted(tmp_path.iterdir())
    return {"walk": [read_learning_curve(folder / "summaries") for folder in folders]}


def test_median_line_is_where_all_have_values():
    line = (np.array([0.0, 2.0]), np.array([0.0, 4.0]))
    other = (np.array([1.0, 4.0]), np.array([0.0, 0.0]))
    x, y = median_line([line, other])
    assert (x[0], x[-1]) == (1.0, 2.0)
    # The median of 2 and 0 is 1, and the median of 4 and 0 is 2.
    assert (y[0], y[-1]) == (1.0, 2.0)


def test_table(two_seeds):
    header, rule, row = markdown_table(two_seeds).splitlines()
    assert header.count("|") == rule.count("|") == row.count("|")
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:3] == ["walk", "2", "none (3.0 to none)"]
    assert cells[5] == "3.5 (3.0 to 4.0)"  # minutes at the end
    assert cells[6] == "2"  # 100 frames a minute
    assert cells[8] == "0.075 (0.050 to 0.100)"


@pytest.mark.parametrize("against", ["minutes", "frames"])
def test_picture(two_seeds, tmp_path, against):
    path = tmp_path / "curves.png"
    draw(two_seeds, path, against)
    assert path.read_bytes().startswith(b"\x89PNG")
