"""The learning curve of a run from its TensorBoard files, and when it reached what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

FloatArray = npt.NDArray[np.float64]

TAGS = {
    # Written after every epoch, the first one of a resumed run included: the curve's clock.
    "fps": ("performance/total_fps", "performance/step_inference_rl_update_fps"),
    "episode_length": ("episode_lengths/frame", "episode_lengths/step"),
    "pose_error_m": ("imitation/pose_error_m",),
    "no_fall_share": ("imitation/no_fall_share",),
    "tempo": ("imitation/tempo",),
    "style_reward": ("info/disc_reward_mean",),
    "episode_return": ("rewards/frame", "rewards/step"),
}
"""Names of curves -> scalar of our agents' runs, and of rl_games' own where it differs."""


@dataclass(frozen=True, eq=False)
class Series:
    """One scalar over a training; three arrays (n,).

    Attributes:
        frames: TensorBoard's step: frames before the epoch that the value is of.
        minutes: time trained when it was written.
        values: the scalar.
    """

    frames: FloatArray
    minutes: FloatArray
    values: FloatArray

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def last(self) -> float:
        """The newest value; nan without one."""
        return float(self.values[-1]) if len(self) else float("nan")

    def first_reach(self, at_least: float) -> tuple[float, float] | None:
        """Return (frames, minutes) of the first value of at least `at_least`; None without one."""
        reached = np.flatnonzero(self.values >= at_least)
        if len(reached) == 0:
            return None
        return float(self.frames[reached[0]]), float(self.minutes[reached[0]])


@dataclass(frozen=True)
class LearningCurve:
    """The scalars of `TAGS` over a training, each possibly without values.

    Minutes are wall-clock from the moment that the agent exists, some seconds after the command;
    measurements and checkpoints on the way are included. A resumed run's parts follow one another
    without the pause. What was trained after the checkpoint that it went on from is lost, and so
    are its values and its minutes.
    """

    series: Mapping[str, Series]

    def __getitem__(self, name: str) -> Series:
        return self.series[name]

    @property
    def minutes(self) -> float:
        """Minutes trained so far."""
        clock = self.series["fps"].minutes
        return float(clock[-1]) if len(clock) else 0.0

    def minutes_at(self, frames: float) -> float:
        """Return the minutes trained when a checkpoint of so many frames was written."""
        clock = self.series["fps"]
        before = int(np.searchsorted(clock.frames, frames))
        return float(clock.minutes[before - 1]) if before else 0.0


def read_learning_curve(summaries: Path) -> LearningCurve:
    """Read the event files in a run's folder summaries/; an empty curve if there are none."""
    parts: dict[str, list[FloatArray]] = {name: [] for name in TAGS}  # of arrays (n, 3)
    for file in sorted(summaries.glob("events.out.tfevents.*")):
        part = _read_file(file)
        if not len(part["fps"]):
            continue
        resumed_at = min(rows[0, 0] for rows in part.values() if len(rows))
        for rows in parts.values():
            rows[:] = [earlier[earlier[:, 0] < resumed_at] for earlier in rows]
        offset_min = max((rows[-1, 1] for rows in parts["fps"] if len(rows)), default=0.0)
        for name, rows in part.items():
            rows[:, 1] += offset_min
            parts[name].append(rows)
    return LearningCurve({name: _series(rows) for name, rows in parts.items()})


def _read_file(file: Path) -> dict[str, FloatArray]:
    """Return for every curve the rows (frames, minutes, value) of one process."""
    events = EventAccumulator(str(file), {"scalars": 0})
    events.Reload()
    present = events.Tags()["scalars"]
    rows: dict[str, FloatArray] = {}
    for name, tags in TAGS.items():
        tag = next((tag for tag in tags if tag in present), None)
        scalars = events.Scalars(tag) if tag else []
        start = events.FirstEventTimestamp() if scalars else 0.0
        rows[name] = np.array(
            [(e.step, (e.wall_time - start) / 60.0, e.value) for e in scalars], dtype=np.float64
        ).reshape(-1, 3)
    return rows


def _series(parts: Sequence[FloatArray]) -> Series:
    rows = np.concatenate([np.zeros((0, 3)), *parts])
    return Series(rows[:, 0], rows[:, 1], rows[:, 2])
