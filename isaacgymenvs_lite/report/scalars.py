"""Reads the scalars of a run from its TensorBoard files, and joins the files of a resumed run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

FPS_TAGS = ("performance/total_fps", "performance/step_inference_rl_update_fps")
"""The tags that measure the time of a run. The agents of this project and of rl_games write one of
these tags after every epoch."""

# A tag with one of these suffixes has epochs or seconds in place of frames as its step. Most of
# these scalars also exist with frames as their step.
_OTHER_AXES = ("/iter", "/time")
_OVER_EPOCHS = "Episode/"


@dataclass(frozen=True, eq=False)
class Series:
    """One scalar over a training.

    Attributes:
        frames: (n,) frames before the epoch of each value, which are the step in TensorBoard.
        minutes: (n,) training time of each value.
        values: (n,) the scalar.
        resumed_at: frames at which the training was resumed.
    """

    frames: FloatArray
    minutes: FloatArray
    values: FloatArray
    _: KW_ONLY
    resumed_at: tuple[float, ...] = ()

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def last(self) -> float:
        """The newest value, or nan if there are no values."""
        return float(self.values[-1]) if len(self) else float("nan")

    def without(self, frames: float) -> Series:
        """Return the series without values in the first `frames` frames after each resumption."""
        kept = np.ones(len(self), dtype=bool)
        for start in self.resumed_at:
            kept &= (self.frames < start) | (self.frames >= start + frames)
        return self.rows(kept)

    def rows(self, kept: npt.NDArray[np.bool_]) -> Series:
        """Return the values at which `kept` (n,) is True."""
        columns = (self.frames[kept], self.minutes[kept], self.values[kept])
        return Series(*columns, resumed_at=self.resumed_at)

    def first_reach(self, at_least: float) -> tuple[float, float] | None:
        """Return (frames, minutes) of the first value of at least `at_least`, or None."""
        reached = np.flatnonzero(self.values >= at_least)
        if len(reached) == 0:
            return None
        return float(self.frames[reached[0]]), float(self.minutes[reached[0]])


NOTHING = Series(np.zeros(0), np.zeros(0), np.zeros(0))
"""A scalar without values."""


def first_of(scalars: Mapping[str, Series], tags: Sequence[str]) -> Series:
    """Return the scalar of the first tag that exists, or `NOTHING` if no tag exists."""
    return next((scalars[tag] for tag in tags if tag in scalars), NOTHING)


def event_files(summaries: Path) -> list[Path]:
    """Return the event files in a run's folder summaries/ in chronological order."""
    return sorted(file for file in summaries.glob("events.out.tfevents.*") if file.is_file())


def read_scalars(summaries: Path) -> dict[str, Series]:
    """Read all scalars over frames from the event files in a run's folder summaries/.

    Minutes are wall-clock time since the agent was made, some seconds after the start of the
    command; the minutes include measurements and checkpoints. The time between the parts of a
    resumed run does not count. Values and minutes after the checkpoint from which a run was resumed
    are left out.

    Returns:
        A dictionary from tags to scalars, which is empty if no file has an epoch.
    """
    parts: dict[str, list[FloatArray]] = {}  # arrays (n, 3)
    starts: list[float] = []
    for file in event_files(summaries):
        part = _read_file(file)
        resumed_at = min((part[tag][0, 0] for tag in FPS_TAGS if tag in part), default=None)
        if resumed_at is None:
            continue
        for rows in parts.values():
            rows[:] = [earlier[earlier[:, 0] < resumed_at] for earlier in rows]
        clocks = [rows for tag in FPS_TAGS for rows in parts.get(tag, ())]
        offset_min = max((rows[-1, 1] for rows in clocks if len(rows)), default=0.0)
        starts = [*(start for start in starts if start < resumed_at), float(resumed_at)]
        for tag, rows in part.items():
            rows[:, 1] += offset_min
            parts.setdefault(tag, []).append(rows)
    joined = {tag: np.concatenate(rows) for tag, rows in parts.items()}
    resumed = tuple(starts[1:])
    return {tag: Series(*rows.T, resumed_at=resumed) for tag, rows in joined.items() if len(rows)}


def _read_file(file: Path) -> dict[str, FloatArray]:
    """Return rows (frames, minutes, value) for every scalar over frames in one event file."""
    # This import takes half a second, so error messages come before it.
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(file), {"scalars": 0})
    events.Reload()
    rows: dict[str, FloatArray] = {}
    for tag in events.Tags()["scalars"]:
        if tag.endswith(_OTHER_AXES) or tag.startswith(_OVER_EPOCHS):
            continue
        scalars, start = events.Scalars(tag), events.FirstEventTimestamp()
        rows[tag] = np.array(
            [(e.step, (e.wall_time - start) / 60.0, e.value) for e in scalars], dtype=np.float64
        )
    return rows
