from __future__ import annotations

import numpy as np
import pytest

from benchmarks import curves
from benchmarks.curves import (
    draw,
    draw_returns,
    markdown_table,
    markdown_table_of_measurements,
    markdown_table_of_returns,
    median_line,
    with_gaps,
)
from benchmarks.evaluate import CURVES, RESULTS_DIR
from benchmarks.learning_curve import read_learning_curve
from benchmarks.saved_curves import find_saved_curves
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.report.scalars import Series


@pytest.fixture
def two_seeds(write_events, tmp_path):
    """Seed 1 reaches 280 in its third minute, seed 2 never."""
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
    # at 1: median of 2 and 0, at 2: of 4 and 0
    assert (y[0], y[-1]) == (1.0, 2.0)


@pytest.mark.parametrize(
    "lines",
    [
        [],
        [(np.zeros(0), np.zeros(0)), (np.ones(1), np.ones(1))],
        [(np.array([0.0, 1.0]), np.zeros(2)), (np.array([2.0, 3.0]), np.zeros(2))],
    ],
)
def test_median_line_of_nothing_common_is_empty(lines):
    assert [len(part) for part in median_line(lines)] == [0, 0]


def test_a_line_is_broken_where_its_run_was_resumed():
    frames = np.array([0.0, 100.0, 700.0])
    series = Series(frames, frames, np.array([1.0, 2.0, 3.0]), resumed_at=(200.0, 800.0))
    x, y = with_gaps(series, frames)
    np.testing.assert_equal(x, [0.0, 100.0, np.nan, 700.0])
    np.testing.assert_equal(y, [1.0, 2.0, np.nan, 3.0])


def test_the_kept_curves_have_no_cliffs():
    """Those of Humanoid and Anymal fell to nothing where their runs were resumed."""
    for experiment in ("humanoid", "anymal"):
        for curve in find_saved_curves(experiment, RESULTS_DIR / CURVES):
            returns = curve.even("episode_return").values
            high = returns[:-1] > 10.0
            assert (returns[1:][high] > 0.6 * returns[:-1][high]).all()


def test_table(two_seeds):
    header, rule, row = markdown_table(two_seeds).splitlines()
    assert header.count("|") == rule.count("|") == row.count("|")
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:3] == ["walk", "2", "none (3.0 to none)"]
    assert cells[5] == "3.5 (3.0 to 4.0)"  # minutes at the end
    assert cells[6] == "2"  # 100 frames a minute
    assert cells[8] == "0.075 (0.050 to 0.100)"


def test_command_prints_the_table_of_all_seeds(two_seeds, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["curves", "walk", "--runs-dir", str(tmp_path)])
    curves.main()
    assert capsys.readouterr().out.strip() == markdown_table(two_seeds)


@pytest.mark.parametrize("against", ["minutes", "frames"])
def test_picture(two_seeds, tmp_path, against):
    pytest.importorskip("matplotlib")
    path = tmp_path / "curves.png"
    draw(two_seeds, path, against)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_table_of_returns(two_seeds):
    row = markdown_table_of_returns(two_seeds).splitlines()[2]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    # ten times the lengths 290 and 30 at frames 300 and 200
    assert cells[:2] == ["walk", "2"]
    assert cells[3] == "1,600.0 (300.0 to 2,900.0)"


def test_picture_of_returns(two_seeds, tmp_path):
    pytest.importorskip("matplotlib")
    path = tmp_path / "returns.png"
    draw_returns(two_seeds | {"run": two_seeds["walk"]}, path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_picture_without_a_folder(two_seeds, tmp_path):
    pytest.importorskip("matplotlib")
    with pytest.raises(ConfigError, match="does not exist"):
        draw(two_seeds, tmp_path / "absent" / "curves.png")


def test_the_course_of_a_run_has_a_row_for_each_measurement(two_seeds):
    text = markdown_table_of_measurements(two_seeds)
    first, second = text.split("walk, run 2")
    rows = [line.split(" | ") for line in first.splitlines()[4:] if line]
    # at 100 frames an episode length of 100, at 200 one of 280; minutes count the epochs before
    assert [row[2] for row in rows] == ["100", "280"]
    assert [row[7] for row in rows] == ["0.100", "0.050"]
    assert {row[3] for row in rows} == {"-"}  # no falls were written
    assert "| 20 |" in second
    assert "| 30 |" in second
