"""Learning curves that outlive their run folders: thinned, one JSON file for each run."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.learning_curve import TAGS, LearningCurve
from benchmarks.records import GOOD_EPISODE_STEPS
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.report.scalars import Series

_POINTS = 100
_SIGNIFICANT_DIGITS = 5
_RUN = "run"


def save_curve(curve: LearningCurve, file: Path) -> None:
    """Write a curve of about a hundred points; makes the folder."""
    run = {"num_envs": curve.num_envs, "resumed_at": [int(x) for x in curve["fps"].resumed_at]}
    series = _with_shared_clocks({name: _columns(_thinned(curve[name])) for name in curve.series})
    file.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({_RUN: run, **series}, separators=(",", ":"))
    file.write_text(text + "\n", encoding="utf-8")


def load_curve(file: Path) -> LearningCurve:
    """Read a file of `save_curve`."""
    columns = json.loads(file.read_text(encoding="utf-8"))
    run = columns.pop(_RUN, {"num_envs": 0, "resumed_at": []})
    resumed_at = tuple(run["resumed_at"])
    series = {
        name: Series(
            *(np.array(c, dtype=np.float64) for c in _columns_of(columns, name)),
            resumed_at=resumed_at,
        )
        for name in TAGS
    }
    return LearningCurve(series, run["num_envs"])


def find_saved_curves(experiment: str, folder: Path) -> list[LearningCurve]:
    """Return the curves of all seeds of an experiment, by seed.

    Raises:
        ConfigError: there are none.
    """
    pattern = re.compile(re.escape(experiment) + r"_seed(\d+)")
    found = {
        int(seed[1]): file
        for file in folder.glob(f"{experiment}_seed*.json")
        if (seed := pattern.fullmatch(file.stem))
    }
    if not found:
        present = ", ".join(sorted(file.stem for file in folder.glob("*.json"))) or "nothing"
        raise ConfigError(f"'{experiment}': no saved curve in {folder} (there: {present})")
    return [load_curve(found[seed]) for seed in sorted(found)]


def _thinned(series: Series) -> Series:
    """Keep evenly spread values, the last one, and the first that is good enough."""
    kept = np.linspace(0, len(series) - 1, min(_POINTS, len(series))).round().astype(int)
    good = np.flatnonzero(series.values >= GOOD_EPISODE_STEPS)[:1]
    rows = np.union1d(kept, good)
    columns = (series.frames[rows], series.minutes[rows], series.values[rows])
    return Series(*columns, resumed_at=series.resumed_at)


def _columns(series: Series) -> list[list[float]]:
    """Return frames, minutes and values, rounded."""
    columns = (series.frames, series.minutes, series.values)
    frames, minutes, values = (column.tolist() for column in columns)
    return [
        [int(x) for x in frames],
        [round(x, 3) for x in minutes],
        [float(f"{x:.{_SIGNIFICANT_DIGITS}g}") for x in values],
    ]


def _with_shared_clocks(columns: dict[str, list[list[float]]]) -> dict[str, list[Any]]:
    """Return `[other, values]` for a series with the frames and minutes of an earlier one."""
    shared: dict[str, list[Any]] = {}
    owners: dict[str, str] = {}
    for name, (*clock, values) in columns.items():
        owner = owners.setdefault(repr(clock), name)
        shared[name] = [*clock, values] if owner == name else [owner, values]
    return shared


def _columns_of(columns: dict[str, list[Any]], name: str) -> list[list[float]]:
    """Return frames, minutes and values of a series; empty if it was not kept at that time."""
    *clock, values = columns.get(name, [[], [], []])
    if len(clock) == 1:
        clock = columns[clock[0]][:2]
    return [*clock, values]
