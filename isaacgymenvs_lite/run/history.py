"""What happened so far in a training, in the form in which `advice` asks for it."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from isaacgymenvs_lite.run.metrics import EpochMetrics


@dataclass(frozen=True)
class Measurement:
    """One measurement of the mean policy against the clips.

    Attributes:
        frame: environment steps trained before it.
        pose_error_m: see `ImitationResult`; nan if no episode could be measured.
        tempo: see `ImitationResult`.
        no_fall_share: share of the episodes without a fall, 0 to 1.
        clip_spread_m: `clip_spread_m` of the clips: about 0 where they stand still.
    """

    frame: int
    pose_error_m: float
    tempo: float
    no_fall_share: float
    clip_spread_m: float


class RunHistory:
    """A window of the last epochs, and all measurements of the pose error.

    Args:
        window_frames: least number of environment steps in the window.
        window_epochs: least number of epochs in the window.
    """

    def __init__(self, window_frames: int, window_epochs: int) -> None:
        self._window_frames = window_frames
        self._window_epochs = window_epochs
        self._window: deque[EpochMetrics] = deque()
        self._first_frame = 0
        self.measurements: list[Measurement] = []

    def add_epoch(self, figures: EpochMetrics) -> None:
        """Append an epoch; those that the window does not need are dropped."""
        if not self._window:
            self._first_frame = figures.frame
        self._window.append(figures)
        while len(self._window) > 1 and self._reaches_back_to(self._window[1]):
            self._window.popleft()

    def _reaches_back_to(self, figures: EpochMetrics) -> bool:
        newest = self._window[-1]
        return (
            newest.frame - figures.frame >= self._window_frames
            and newest.epoch - figures.epoch >= self._window_epochs
        )

    @property
    def newest(self) -> EpochMetrics:
        """The newest epoch; there must be one."""
        return self._window[-1]

    @property
    def window_is_full(self) -> bool:
        """Whether the run is as long as the window."""
        return len(self._window) > 0 and self._reaches_back_to(self._window[0])

    @property
    def window_frames(self) -> int:
        """Environment steps in the window."""
        return self._window[-1].frame - self._window[0].frame

    @property
    def frames_trained(self) -> int:
        """Environment steps of this run; a resumed one counts its own."""
        return self._window[-1].frame - self._first_frame

    def median(self, figure: Callable[[EpochMetrics], float | None]) -> float:
        """Return the median of a figure over the window, nan if it is not known."""
        return _median([figure(epoch) for epoch in self._window])

    def growth(self, figure: Callable[[EpochMetrics], float | None]) -> float:
        """Return the median over the window's last third, as a multiple of the first third's.

        Nan if it is not known or began at 0.
        """
        values = [figure(epoch) for epoch in self._window]
        third = max(1, len(values) // 3)
        before = _median(values[:third])
        return _median(values[-third:]) / before if before != 0 else math.nan

    def measured(self, after: float = -math.inf, until: float = math.inf) -> list[Measurement]:
        """Return the measurements at frames in (after, until] that found a pose error."""
        return [
            measurement
            for measurement in self.measurements
            if after < measurement.frame <= until and math.isfinite(measurement.pose_error_m)
        ]

    def pose_error_improved_since(self, frame: float, by: float) -> bool:
        """Return whether the best pose error after `frame` beats the one until then by a share.

        True as well while one of the two is not known.
        """
        before = [measurement.pose_error_m for measurement in self.measured(until=frame)]
        after = [measurement.pose_error_m for measurement in self.measured(after=frame)]
        return not before or not after or min(after) < (1.0 - by) * min(before)


def _median(values: list[float | None]) -> float:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else math.nan
