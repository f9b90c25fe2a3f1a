"""Draws learning curves of runs and prints their table.

    python -m benchmarks.curves TARGET [TARGET ...] --out docs/images/NAME.png
        [--runs-dir runs/benchmarks] [--against minutes|frames] [--returns]

A target is a run folder or the name of an experiment. Thin lines show the seeds, and a thick line
shows their median. `--returns` draws the return of training episodes, with one panel for each
experiment. Without `--out` the command prints the table only.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import tables
from benchmarks.learning_curve import LearningCurve, read_learning_curve
from benchmarks.records import GOOD_EPISODE_STEPS, spread_cell
from benchmarks.runs import DEFAULT_RUNS_DIR, find_runs
from isaacgymenvs_lite.errors import ConfigError, UserError
from isaacgymenvs_lite.report.scalars import FloatArray, Series

_PANELS = {
    "episode_length": "episode length in training (steps)",
    "pose_error_m": "pose error (m)",
    "tempo": "tempo (the clip's: 1)",
    "style_reward": "style reward per step",
}
_AXES = {"minutes": ("minutes", 1.0), "frames": ("million frames", 1e-6)}
_MEDIAN_POINTS = 400

Curves = Mapping[str, Sequence[LearningCurve]]
"""The type maps the name of an experiment to the curves of its seeds."""


def median_line(lines: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Return the median of lines (x, y) over the range of x that all lines cover.

    The result is empty if the lines have no common range.
    """
    empty = np.zeros(0)
    if not lines or any(len(x) == 0 for x, _ in lines):
        return empty, empty
    first, last = max(x[0] for x, _ in lines), min(x[-1] for x, _ in lines)
    if last < first:
        return empty, empty
    at = np.linspace(first, last, _MEDIAN_POINTS)
    return at, np.median([np.interp(at, x, y) for x, y in lines], axis=0)


def draw(curves: Curves, path: Path, against: str) -> None:
    """Write a picture with one panel for each quantity of `_PANELS`.

    Args:
        curves: the learning curves.
        path: the picture, .png or .svg.
        against: the x axis, `minutes` or `frames`.

    Raises:
        ConfigError: the folder of `path` does not exist.
    """
    figure: Any = _figure(path, len(_PANELS))
    panels = figure.subplots(1, len(_PANELS))
    for panel, (name, title) in zip(panels, _PANELS.items(), strict=True):
        for i, (experiment, seeds) in enumerate(curves.items()):
            _draw_seeds(panel, [curve.even(name) for curve in seeds], against, f"C{i}", experiment)
        _finish(panel, title, against)
        panel.set_ylim(0.0, _top([curve[name] for seeds in curves.values() for curve in seeds]))
    panels[0].axhline(GOOD_EPISODE_STEPS, color="0.4", linestyle=":", linewidth=1.0)
    panels[0].legend(fontsize=8, loc="lower right")
    figure.savefig(path)


def draw_returns(curves: Curves, path: Path, against: str) -> None:
    """Write a picture of the training returns with one panel for each experiment; see `draw`."""
    figure: Any = _figure(path, len(curves))
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for panel, (experiment, seeds) in zip(panels, curves.items(), strict=True):
        _draw_seeds(panel, [curve.even("episode_return") for curve in seeds], against, "C0")
        _finish(panel, experiment, against)
    panels[0].set_ylabel("return of training episodes", fontsize=10)
    figure.savefig(path)


def _draw_seeds(
    panel: Any, seeds: Sequence[Series], against: str, color: str, label: str | None = None
) -> None:
    scale = _AXES[against][1]
    lines = [(getattr(series, against) * scale, series.values) for series in seeds]
    for x, y in lines:
        panel.plot(x, y, color=color, linewidth=0.6, alpha=0.6)
    panel.plot(*median_line(lines), color=color, linewidth=2.0, label=label)


def _finish(panel: Any, title: str, against: str) -> None:
    panel.set_title(title, fontsize=10)
    panel.set_xlabel(_AXES[against][0])
    panel.grid(alpha=0.3)


def _top(series: Sequence[Series]) -> float | None:
    """Return the upper end of the y axis without the outliers of the first epochs."""
    values = np.concatenate([s.values for s in series])
    return 1.1 * float(np.percentile(values, 99)) if len(values) else None


def _figure(path: Path, num_panels: int) -> Any:
    from matplotlib.figure import Figure

    if not path.absolute().parent.is_dir():
        raise ConfigError(f"--out {path}: the folder {path.absolute().parent} does not exist")
    return Figure(figsize=(max(12.0, 2.4 * num_panels), 3.6), dpi=110, layout="constrained")


def markdown_table(curves: Curves) -> str:
    """Return a Markdown table of the measurements during training, see `spread_cell`."""
    headings = (
        "experiment",
        "seeds",
        f"minutes to {GOOD_EPISODE_STEPS} steps",
        f"frames to {GOOD_EPISODE_STEPS} steps (M)",
        "frames at the end (M)",
        "minutes at the end",
        "frames/s",
        "last episode length",
        "last pose error (m)",
    )
    rows = []
    for experiment, seeds in curves.items():
        reached = [c["episode_length"].first_reach(GOOD_EPISODE_STEPS) for c in seeds]
        cells = [
            spread_cell([None if r is None else r[1] for r in reached], ".1f"),
            spread_cell([None if r is None else r[0] / 1e6 for r in reached], ".2f"),
            spread_cell(
                [c["fps"].frames[-1] / 1e6 if len(c["fps"]) else None for c in seeds], ".2f"
            ),
            spread_cell([c.minutes for c in seeds], ".1f"),
            spread_cell([_frames_per_s(c) for c in seeds], ",.0f"),
            spread_cell([c["episode_length"].last for c in seeds], ".0f"),
            spread_cell([c["pose_error_m"].last for c in seeds], ".3f"),
        ]
        rows.append([experiment, f"{len(seeds)}", *cells])
    return tables.markdown(headings, rows)


def markdown_table_of_returns(curves: Curves) -> str:
    """Return a Markdown table of the returns of training episodes, see `spread_cell`."""
    rows = []
    for experiment, seeds in curves.items():
        returns = [curve["episode_return"] for curve in seeds]
        cells = [
            spread_cell([s.frames[-1] / 1e6 if len(s) else None for s in returns], ".1f"),
            spread_cell([s.last for s in returns], ",.1f"),
            spread_cell([float(s.values.max()) if len(s) else None for s in returns], ",.1f"),
        ]
        rows.append([experiment, f"{len(seeds)}", *cells])
    headings = ("experiment", "seeds", "frames (M)", "last return", "best return")
    return tables.markdown(headings, rows)


def _frames_per_s(curve: LearningCurve) -> float | None:
    """Return the frames per second of the whole training, including evaluations."""
    clock = curve["fps"]
    if len(clock) < 2:
        return None
    return float(np.ptp(clock.frames) / (60.0 * np.ptp(clock.minutes)))


def main() -> None:
    """Print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("targets", nargs="+", help="run folders or experiments")
    parser.add_argument("--out", type=Path, help="picture to write, .png or .svg")
    parser.add_argument("--runs-dir", type=Path, default=DEFAULT_RUNS_DIR)
    parser.add_argument("--against", choices=sorted(_AXES), default="minutes")
    parser.add_argument("--returns", action="store_true", help="returns of classic tasks")
    args = parser.parse_intermixed_args()
    table, picture = (
        (markdown_table_of_returns, draw_returns) if args.returns else (markdown_table, draw)
    )
    curves: dict[str, list[LearningCurve]] = {}
    try:
        for target in args.targets:
            for run in find_runs(target, args.runs_dir):
                curve = read_learning_curve(run.folder / "summaries")
                curves.setdefault(run.experiment, []).append(curve)
        print(table(curves))
        if args.out:
            picture(curves, args.out, args.against)
            print(f"wrote {args.out}")
    except UserError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
