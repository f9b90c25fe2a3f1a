from __future__ import annotations

import numpy as np

from benchmarks.learning_curve import read_learning_curve
from isaacgymenvs_lite.report.scalars import Series


def series(frames, minutes, values) -> Series:
    return Series(*(np.array(x, dtype=np.float64) for x in (frames, minutes, values)))


def test_frames_minutes_and_values(write_events, tmp_path):
    write_events(tmp_path, [None, 20.0, 30.0], poses={2: 0.0625})
    curve = read_learning_curve(tmp_path)
    length = curve["episode_length"]
    assert length.frames.tolist() == [100, 200]
    # the first minute counts
    assert length.minutes.tolist() == [2.0, 3.0]
    assert length.values.tolist() == [20.0, 30.0]
    assert curve["pose_error_m"].values.tolist() == [0.0625]
    assert curve["pose_error_m"].frames.tolist() == [200]
    assert curve["style_reward"].last == 0.5
    assert curve.minutes == 3.0


def test_parts_of_a_resumed_run_follow_one_another_without_the_pause(write_events, tmp_path):
    write_events(tmp_path, [10.0, 20.0])
    write_events(tmp_path, [30.0, 40.0], first_epoch=2, start_s=99_000.0)
    curve = read_learning_curve(tmp_path)
    assert curve["episode_length"].frames.tolist() == [0, 100, 200, 300]
    assert curve["episode_length"].minutes.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert curve["episode_length"].values.tolist() == [10.0, 20.0, 30.0, 40.0]


def test_a_resumed_run_is_even_after_two_whole_episodes(write_events, tmp_path):
    (tmp_path / "config.yaml").write_text("task: {env: {numEnvs: 10}}\n")
    summaries = tmp_path / "summaries"
    write_events(summaries, [10.0, 20.0, 20.0])
    # In 10 environments with 100 frames an epoch, two episodes of 20 steps take four epochs.
    write_events(summaries, [1.0, 9.0, 18.0, 20.0, 19.0, 20.0], first_epoch=3, start_s=9_000.0)
    curve = read_learning_curve(summaries)
    assert curve["fps"].resumed_at == (300.0,)
    assert curve["episode_length"].values[3] == 1.0
    assert curve.even("episode_length").values.tolist() == [10.0, 20.0, 20.0, 19.0, 20.0]
    assert curve.even("episode_length").frames.tolist() == [0, 100, 200, 700, 800]
    assert len(curve.even("episode_return")) == 5
    assert len(curve.even("style_reward")) == 9  # independent of episodes


def test_what_came_after_the_checkpoint_is_lost_with_its_minutes(write_events, tmp_path):
    # The run was killed after five epochs and resumed from the second checkpoint.
    write_events(tmp_path, [1.0, 2.0, 3.0, 4.0, 5.0], poses={1: 0.5, 4: 0.25})
    write_events(tmp_path, [None, 13.0], first_epoch=2, start_s=99_000.0)
    curve = read_learning_curve(tmp_path)
    assert curve["episode_length"].values.tolist() == [1.0, 2.0, 13.0]
    assert curve["episode_length"].minutes.tolist() == [1.0, 2.0, 4.0]
    assert curve["pose_error_m"].values.tolist() == [0.5]
    assert curve.minutes == 4.0


def test_first_reach():
    for at_least, expected in [
        (280.0, (300.0, 2.5)),  # a later fall does not count
        (279.9, (200.0, 1.5)),
        (7.0, (100.0, 0.5)),
        (285.0, (500.0, 4.5)),
        (285.1, None),
    ]:
        curve = series(
            [100, 200, 300, 400, 500], [0.5, 1.5, 2.5, 3.5, 4.5], [7, 279.9, 280, 275, 285]
        )
        assert curve.first_reach(at_least) == expected
