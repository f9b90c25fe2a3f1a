"""Draws trainings of benchmarks/results/hard_clips_attempts.jsonl, good and bad ones, side by side.

    python -m benchmarks.attempts RUN=TITLE [RUN=TITLE ...] --out docs/images/NAME.png

RUN is the name of a line; `--list` prints them. Each panel shows what the mean policy did in 16
episodes: how long they lasted, how much of the clip's motion they showed, and the pose error.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.curves import figure_for
from benchmarks.evaluate import RESULTS_DIR
from isaacgymenvs_lite.errors import ConfigError, UserError, unknown

ATTEMPTS = RESULTS_DIR / "hard_clips_attempts.jsonl"
_EPISODE_STEPS = 299.0
_ERROR_OF_ONE_M = 0.3  # the pose error that is drawn at the top


def read_attempts(file: Path = ATTEMPTS) -> dict[str, list[dict[str, float]]]:
    """Return run -> its measurements, each column -> number, without those that lack a number."""
    attempts = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        attempt = json.loads(line)
        rows = [dict(zip(attempt["columns"], row, strict=True)) for row in attempt["points"]]
        attempts[attempt["run"]] = [row for row in rows if None not in row.values()]
    return attempts


def draw(titles: Mapping[str, str], out: Path, file: Path = ATTEMPTS) -> None:
    """Write a picture with a panel for each run -> its title.

    Raises:
        UserError: there is no such run or folder, or matplotlib is not installed.
    """
    attempts = read_attempts(file)
    for run in titles:
        if run not in attempts:
            raise ConfigError(unknown("run", run, attempts))
    figure = figure_for(out, (3.0 * len(titles), 2.8))
    panels = figure.subplots(1, len(titles), squeeze=False, sharey=True).ravel()
    for panel, (run, title) in zip(panels, titles.items(), strict=True):
        _draw_run(panel, attempts[run])
        panel.set_title(title, fontsize=9)
        panel.set_xlabel("million frames")
    panels[0].legend(fontsize=7)
    figure.savefig(out)


def _draw_run(panel: Any, rows: Sequence[Mapping[str, float]]) -> None:
    frames = [row["frames"] * 1e-6 for row in rows]

    def line(column: str, unit: float, label: str, color: str) -> None:
        panel.plot(frames, [row[column] / unit for row in rows], label=label, color=color)

    line("episode_steps", _EPISODE_STEPS, "episode length, of 299 steps", "C7")
    line("motion_shown", 1.0, "motion shown", "C0")
    line("pose_error_m", _ERROR_OF_ONE_M, f"pose error, of {_ERROR_OF_ONE_M:g} m", "C3")
    panel.set_ylim(0.0, 1.05)


def main() -> None:
    """Draw, or list."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="*", metavar="RUN=TITLE")
    parser.add_argument("--out", type=Path, default=Path("attempts.png"))
    parser.add_argument("--list", action="store_true", help="print the names of the runs")
    args = parser.parse_args()
    try:
        if args.list or not args.runs:
            sys.stdout.write("\n".join([*read_attempts(), ""]))
            return
        words = (run.partition("=") for run in args.runs)
        draw({run: title or run for run, _, title in words}, args.out)
    except UserError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
