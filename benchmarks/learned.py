"""Decides whether a policy has learned its clip, and when a training learned it.

A measurement is good if four quantities are within their limits. The pose error is at most the AMP
paper's value for the clip, or 0.06 m if the paper has no value. At least 0.9 of the episodes end
without a fall. The motion shown (the share of the clip's motion that the policy performs) is at
least 0.5. The tempo is between 0.6 and 1.5.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from benchmarks.learning_curve import LearningCurve
from benchmarks.records import Record

# The AMP paper reports these pose errors in m.
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
# A standing policy shows about 0.1 of a moving clip, a policy with tempo 0.5 shows about 0.5.
_GOOD_SHOWN = 0.5
_GOOD_TEMPO = (0.6, 1.5)
_IN_A_ROW = 2
_MEASURED = ("pose_error_m", "no_fall_share", "motion_shown", "tempo")


def allowed_error(label: str) -> tuple[float, bool]:
    """Return the limit of a clip's pose error in m, and whether the AMP paper reports it."""
    return _PAPER_M.get(label, _GOOD_M), label in _PAPER_M


def is_learned(record: Record) -> bool:
    """Return whether the measurement of a policy is good."""
    values = [getattr(record, name) for name in _MEASURED]
    if any(value is None for value in values):
        return False
    return bool(_are_good(record.experiment, *np.array(values)[:, None])[0])


def has_learned(label: str, curve: LearningCurve) -> bool:
    """Return whether the last two measurements of a training are good."""
    good = _good_measurements(label, curve)[-_IN_A_ROW:]
    return len(good) == _IN_A_ROW and bool(good.all())


def first_learned(label: str, curve: LearningCurve) -> tuple[float, float] | None:
    """Return frames and minutes when two measurements in a row were good for the first time."""
    good = _good_measurements(label, curve)
    (rows,) = np.nonzero(good[1:] & good[:-1])
    if len(rows) == 0:
        return None
    measured, row = curve[_MEASURED[0]], int(rows[0]) + 1 - len(good)
    return float(measured.frames[row]), float(measured.minutes[row])


def _good_measurements(label: str, curve: LearningCurve) -> npt.NDArray[np.bool_]:
    series = [curve[name].values for name in _MEASURED]
    count = min(len(values) for values in series)  # old runs lack early values of motion_shown
    return _are_good(label, *(values[len(values) - count :] for values in series))


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
