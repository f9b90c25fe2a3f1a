from __future__ import annotations

import math

import pytest

from isaacgymenvs_lite.run import EpochMetrics
from isaacgymenvs_lite.run.history import Measurement, RunHistory


def history_of(steps: list[float | None], frames: int = 100, epochs: int = 3) -> RunHistory:
    """A history of epochs of 10 frames with these episode lengths."""
    history = RunHistory(frames, epochs)
    for index, length in enumerate(steps):
        history.add_epoch(EpochMetrics(index + 1, 1000 + 10 * index, length))
    return history


def length(figures: EpochMetrics) -> float | None:
    return figures.episode_steps


def measurement(frame: int, pose_error_m: float) -> Measurement:
    return Measurement(frame, pose_error_m, 1.0, 1.0, 0.1)


def test_a_window_is_full_when_it_has_the_frames():
    assert not history_of([1.0] * 10).window_is_full
    assert history_of([1.0] * 11).window_is_full
    assert history_of([1.0] * 11).window_frames == 100


def test_a_window_is_full_when_it_has_the_epochs():
    assert not history_of([1.0] * 15, frames=0, epochs=15).window_is_full
    assert history_of([1.0] * 16, frames=0, epochs=15).window_is_full


def test_no_epoch_makes_no_window():
    assert not history_of([]).window_is_full


def test_the_window_moves_on_and_the_run_is_counted_from_its_start():
    history = history_of([float(index) for index in range(30)])
    assert history.window_frames == 100
    assert history.median(length) == 24.0  # of 19 ... 29
    assert history.frames_trained == 290
    assert history.newest.epoch == 30


def test_growth_is_the_last_third_over_the_first():
    # thirds of three: medians 2 and 8
    history = history_of([1.0, 2.0, 3.0, 50.0, 50.0, 50.0, 7.0, 8.0, 9.0])
    assert history.growth(length) == 4.0


@pytest.mark.parametrize("steps", [[None, None, None], [0.0, 1.0, 2.0]])
def test_growth_that_cannot_be_told(steps):
    assert math.isnan(history_of(steps).growth(length))


def test_unknown_figures_are_left_out():
    assert history_of([None, 4.0, 6.0]).median(length) == 5.0
    assert math.isnan(history_of([None]).median(length))


def test_measurements_of_a_part_of_the_run():
    history = history_of([1.0])
    for frame, error in ((10, 0.1), (20, math.nan), (30, 0.2), (40, 0.3)):
        history.measurements.append(measurement(frame, error))
    assert [one.frame for one in history.measured()] == [10, 30, 40]
    assert [one.frame for one in history.measured(after=10)] == [30, 40]
    assert [one.frame for one in history.measured(until=30)] == [10, 30]


@pytest.mark.parametrize(
    ("before", "after", "improved"),
    [
        ([0.2, 0.1], [0.15, 0.097], True),
        ([0.2, 0.1], [0.15, 0.099], False),  # by 1% only
        ([0.1], [], True),
        ([], [0.1], True),
    ],
)
def test_improvement_is_of_the_best(before, after, improved):
    history = history_of([1.0])
    for index, error in enumerate(before):
        history.measurements.append(measurement(index, error))
    for index, error in enumerate(after):
        history.measurements.append(measurement(100 + index, error))
    assert history.pose_error_improved_since(99, by=0.02) is improved
