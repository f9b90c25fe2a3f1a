"""Decides whether a policy moves as its clip does: in one measurement, and first in a training.

A policy is good with at most the pose error of the AMP paper, or 0.06 m where the paper has none,
at least 0.9 of the episodes without a fall, half of the clip's motion shown and a tempo of 0.6 to
1.5.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from benchmarks.learning_curve import LearningCurve
from benchmarks.records import Record

# Pose errors (m) of the AMP paper; of other clips this one is good.
_PAPER_M = {
    "deepmimic_walk": 0.030,
    "deepmimic_run": 0.075,
    "deepmimic_jump": 0.083,
    "deepmimic_cartwheel": 0.067,
    "deepmimic_backflip": 0.150,
    "deepmimic_roll": 0.072,
    "deepmimic_spinkick": 0.058,
}
_GOOD_M = 0.06
_GOOD_NO_FALL = 0.9
# Standing shows a tenth of the motion of a clip that moves, and half the tempo about a half. A leap
# whose flight is no fall in the clip cannot be shown in full.
_GOOD_SHOWN = 0.5
_GOOD_TEMPO = (0.6, 1.5)
_IN_A_ROW = 2
_MEASURED = ("pose_error_m", "no_fall_share", "motion_shown", "tempo")


def allowed_error(label: str) -> tuple[float, bool]:
    """Return the largest good pose error (m) of a clip, and whether it is the paper's."""
    return _PAPER_M.get(label, _GOOD_M), label in _PAPER_M


def is_learned(record: Record) -> bool:
    """Return whether a policy moves as its clip does, and does not fall."""
    numbers = [getattr(record, name) for name in _MEASURED]
    if any(number is None for number in numbers):
        return False
    return bool(_are_good(record.experiment, *np.array(numbers)[:, None])[0])


def has_learned(label: str, curve: LearningCurve) -> bool:
    """Return whether a training measured, the last two times, that its clip is learned."""
    good = _good_measurements(label, curve)[-_IN_A_ROW:]
    return len(good) == _IN_A_ROW and bool(good.all())


def first_learned(label: str, curve: LearningCurve) -> tuple[float, float] | None:
    """Return (frames, minutes) of the second of the first two good measurements in a row."""
    good = _good_measurements(label, curve)
    (rows,) = np.nonzero(good[1:] & good[:-1])
    if len(rows) == 0:
        return None
    measured, row = curve[_MEASURED[0]], int(rows[0]) + 1 - len(good)
    return float(measured.frames[row]), float(measured.minutes[row])


def _good_measurements(label: str, curve: LearningCurve) -> npt.NDArray[np.bool_]:
    series = [curve[name].values for name in _MEASURED]
    most = min(len(values) for values in series)  # the motion was not always measured
    return _are_good(label, *(values[len(values) - most :] for values in series))


def _are_good(
    label: str,
    pose_error_m: npt.NDArray[np.float64],
    no_fall_share: npt.NDArray[np.float64],
    shown: npt.NDArray[np.float64],
    tempo: npt.NDArray[np.float64],
) -> npt.NDArray[np.bool_]:
    slowest, fastest = _GOOD_TEMPO
    return (
        (pose_error_m <= allowed_error(label)[0])
        & (no_fall_share >= _GOOD_NO_FALL)
        & (shown >= _GOOD_SHOWN)
        & (slowest <= tempo)
        & (tempo <= fastest)
    )
