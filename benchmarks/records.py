"""Collects results of the fixed protocol in records, and prints their medians and tables."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import tables
from benchmarks.runs import plain

GOOD_EPISODE_STEPS = 280
"""A policy counts as stable at this mean episode length in training; the limit is 300 steps."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """Measurements of one policy; None marks an unknown value or a target that was not reached.

    Attributes:
        run: name of the run folder.
        frames: frames of training before the checkpoint.
        minutes: minutes of training before the checkpoint, see `LearningCurve`.
        minutes_to_280: minutes until the mean episode length in training reached 280.
        frames_to_280: frames until the mean episode length in training reached 280.
        minutes_to_learned: minutes until two good measurements in a row, see `benchmarks.learned`.
        frames_to_learned: frames until two good measurements in a row.
        no_fall_share: share of the episodes without a fall.
        motion_shown: share of the clips' motion that the policy performs, 0 to 1, see
            `evaluation.motion_coverage`.
        speed_m_s: mean speed of the root along the ground.
        goal_errors: name -> mean error, for example `velocity_error_m_s`; {} without a goal.
        evaluation_seed: seed of the episodes' starts.
        machine: machine of the training.
        commit: commits of the training, several if it was resumed with another commit.
        cores: number of CPUs of the training.
        settings: the experiment's overrides; files are without their folders.
    """

    experiment: str
    seed: int
    run: str
    checkpoint: str
    frames: int
    epoch: int
    minutes: float | None
    minutes_to_280: float | None
    frames_to_280: float | None
    pose_error_m: float | None
    no_fall_share: float
    tempo: float | None
    speed_m_s: float | None
    clip_speed_m_s: float
    mean_episode_steps: float
    num_episodes: int
    evaluation_seed: int
    machine: str | None
    commit: str | None
    cores: int | None
    settings: list[str] | None
    motion_shown: float | None = None
    minutes_to_learned: float | None = None
    frames_to_learned: float | None = None
    goal_errors: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.experiment} seed {self.seed}: {numbers_line(asdict(self))}"


_MEDIANS = ("frames", "minutes", "pose_error_m", "no_fall_share", "tempo", "motion_shown")
_MEDIANS += ("speed_m_s", "clip_speed_m_s", "mean_episode_steps", "minutes_to_280", "frames_to_280")
_MEDIANS += ("minutes_to_learned", "frames_to_learned")


def medians(records: Sequence[Record]) -> dict[str, Any]:
    """Return the medians over the seeds of one experiment.

    None counts as infinite, for example the minutes to 280 steps of a seed that never reached them.
    A median that is infinite is None.
    """

    def median(values: Iterable[float | None]) -> float | None:
        return plain(float(np.median([_or_infinite(value) for value in values])))

    found: dict[str, Any] = {name: median(getattr(r, name) for r in records) for name in _MEDIANS}
    found["goal_errors"] = {
        name: median(record.goal_errors.get(name) for record in records)
        for name in _error_names(records)
    }
    return found


def _error_names(records: Iterable[Record]) -> list[str]:
    """Return the names of the goal errors, in the order of their first appearance."""
    return list(dict.fromkeys(name for record in records for name in record.goal_errors))


def numbers_line(n: dict[str, Any]) -> str:
    """Return the values of a record or of medians on one line."""
    errors = "".join(f" {name} {_number(e, '.3f')}," for name, e in n["goal_errors"].items())
    return (
        f"{n['frames'] / 1e6:.2f} M frames, {_number(n['minutes'], '.1f')} min;"
        f" pose error {_number(n['pose_error_m'], '.4f')} m,"
        f" without a fall {_number(n['no_fall_share'], '.2f')},"
        f" tempo {_number(n['tempo'], '.2f')},"
        f" motion shown {_number(n['motion_shown'], '.2f')},"
        f" speed {_number(n['speed_m_s'], '.2f')} m/s (clip {n['clip_speed_m_s']:.2f}),"
        f"{errors} episode {n['mean_episode_steps']:.0f} steps;"
        f" learned {_reached(n, 'learned')}, {GOOD_EPISODE_STEPS} steps in training"
        f" {_reached(n, '280')}"
    )


def _reached(n: dict[str, Any], what: str) -> str:
    minutes, frames = n[f"minutes_to_{what}"], n[f"frames_to_{what}"]
    return "never" if minutes is None else f"after {minutes:.1f} min, {frames / 1e6:.2f} M frames"


def _number(value: float | None, form: str) -> str:
    return "?" if value is None else format(value, form)


def by_experiment(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group records, in the order of their first appearance."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record.experiment, []).append(record)
    return groups


def markdown_table(records: Sequence[Record]) -> str:
    """Return a Markdown table with one row for each experiment; see `spread_cell`."""
    columns: list[tuple[str, str, float, str]] = [
        ("frames (M)", "frames", 1e-6, ".1f"),
        ("minutes", "minutes", 1, ".0f"),
        ("pose error (m)", "pose_error_m", 1, ".3f"),
        ("episodes without a fall", "no_fall_share", 1, ".2f"),
        ("tempo", "tempo", 1, ".2f"),
        ("motion shown", "motion_shown", 1, ".2f"),
        ("speed (m/s)", "speed_m_s", 1, ".2f"),
        ("the clip's", "clip_speed_m_s", 1, ".2f"),
        ("minutes until learned", "minutes_to_learned", 1, ".1f"),
        ("frames until learned (M)", "frames_to_learned", 1e-6, ".2f"),
        (f"minutes to {GOOD_EPISODE_STEPS} steps", "minutes_to_280", 1, ".1f"),
        (f"frames to {GOOD_EPISODE_STEPS} steps (M)", "frames_to_280", 1e-6, ".2f"),
    ]
    records = list(records)
    errors = _error_names(records)
    columns += [(name.replace("_", " "), name, 1, ".3f") for name in errors]
    rows = []
    for experiment, group in by_experiment(records).items():
        cells = []
        for _, name, factor, form in columns:
            values = [getattr(record, name, record.goal_errors.get(name)) for record in group]
            scaled = [None if value is None else value * factor for value in values]
            cells.append(spread_cell(scaled, form))
        rows.append([experiment, f"{len(group)}", *cells])
    return tables.markdown(["experiment", "seeds", *(title for title, *_ in columns)], rows)


def spread_cell(values: Sequence[float | None], form: str) -> str:
    """Return "median (lowest to highest)" for a table; None and nan count as infinite.

    >>> spread_cell([11.0, None, 12.5], ".1f")
    '12.5 (11.0 to none)'
    """
    ordered = sorted(_or_infinite(value) for value in values)
    texts = [
        "none" if plain(value) is None else format(value, form)
        for value in (float(np.median(ordered)), ordered[0], ordered[-1])
    ]
    return texts[0] if len(set(texts)) == 1 else f"{texts[0]} ({texts[1]} to {texts[2]})"


def _or_infinite(value: float | None) -> float:
    return float("inf") if value is None or value != value else float(value)


def write_records(records: Iterable[Record], folder: Path) -> list[Path]:
    """Write records to `<folder>/<experiment>.jsonl`, sorted by seed and frames; return the files.

    A record replaces an older record of the same run, frames and evaluation seed. Result lines of
    `benchmarks.hierarchy` in the file are kept and come first.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for experiment, group in by_experiment(records).items():
        file = folder / f"{experiment}.jsonl"
        known = {(r.run, r.frames, r.evaluation_seed): r for r in [*read_records(file), *group]}
        rows = sorted(known.values(), key=lambda r: (r.seed, r.frames, r.evaluation_seed))
        others = [row for row in _rows(file) if not _is_record(row)]
        lines = [*others, *(asdict(row) for row in rows)]
        text = "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines)
        file.write_text(text, encoding="utf-8")
        files.append(file)
    return files


def read_records(file: Path) -> list[Record]:
    """Read the records of a file and ignore unknown keys; a missing file has no records."""
    names = {column.name for column in fields(Record)}
    rows = filter(_is_record, _rows(file))
    return [Record(**{key: row[key] for key in names & row.keys()}) for row in rows]


def _rows(file: Path) -> list[dict[str, Any]]:
    if not file.is_file():
        return []
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]


def _is_record(row: dict[str, Any]) -> bool:
    """Return whether a line has all required keys of `Record`."""
    required = {
        f.name for f in fields(Record) if f.default is MISSING and f.default_factory is MISSING
    }
    return required <= row.keys()
