"""Tests when a policy counts as learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks import learned
from benchmarks.learning_curve import LearningCurve
from isaacgymenvs_lite.report.scalars import Series
from tests.benchmarks.test_records import RECORD


def of(label: str, **changes):
    good = {"pose_error_m": 0.05, "no_fall_share": 1.0, "motion_shown": 0.9, "tempo": 1.2}
    return replace(RECORD, experiment=label, run=f"{label}_seed1", **{**good, **changes})


def test_learned():
    for changes, expected in [
        ({}, True),
        ({"pose_error_m": 0.061}, False),
        ({"pose_error_m": None}, False),
        ({"no_fall_share": 0.8}, False),
        ({"motion_shown": 0.3}, False),  # it stands
        ({"motion_shown": None}, False),
        ({"tempo": 0.5}, False),  # in slow motion
        ({"tempo": 1.6}, False),
    ]:
        assert learned.is_learned(of("dance", **changes)) is expected


def test_the_paper_counts_where_it_has_a_number():
    assert learned.is_learned(of("deepmimic_backflip", pose_error_m=0.14))
    assert not learned.is_learned(of("deepmimic_walk", pose_error_m=0.04))


def curve_of(**measured: list[float]) -> LearningCurve:
    """Return a learning curve with the measurements of the policy only."""
    return LearningCurve(
        {
            name: Series(
                np.linspace(0.0, 100.0, len(v)), np.linspace(0.0, 1.0, len(v)), np.array(v)
            )
            for name, v in measured.items()
        }
    )


GOOD = {
    "pose_error_m": [0.2, 0.06, 0.05],
    "no_fall_share": [0.0, 0.9, 1.0],
    "tempo": [0.3, 0.9, 1.1],
}


def test_a_training_is_over_when_the_clip_is_learned_twice_in_a_row():
    for changes, expected in [
        ({}, True),
        ({"pose_error_m": [0.05, 0.061, 0.05]}, False),  # once only
        ({"no_fall_share": [1.0, 1.0, 0.8]}, False),
        ({"motion_shown": [0.9, 0.9, 0.1]}, False),  # it stands again
        ({"tempo": [1.0, 1.0, 0.5]}, False),
        ({"pose_error_m": [0.05], "no_fall_share": [1.0], "motion_shown": [0.9]}, False),
        ({"pose_error_m": [], "no_fall_share": [], "motion_shown": []}, False),
    ]:
        curve = curve_of(**{**GOOD, "motion_shown": [0.1, 0.8, 0.9], **changes})
        assert learned.has_learned("dance", curve) is expected


def test_when_a_clip_was_first_learned():
    for changes, expected in [
        ({}, (75.0, 0.75)),
        ({"no_fall_share": [1.0, 1.0, 1.0, 0.5, 1.0]}, None),
        ({"motion_shown": [0.9, 0.9]}, (100.0, 1.0)),  # measured from the fourth time on
        ({"motion_shown": []}, None),
    ]:
        measured = {
            "pose_error_m": [0.05, 0.2, 0.06, 0.05, 0.05],
            "no_fall_share": [1.0] * 5,
            "motion_shown": [0.9] * 5,
            "tempo": [1.0] * 5,
        }
        assert learned.first_learned("dance", curve_of(**{**measured, **changes})) == expected
