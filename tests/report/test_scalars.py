from __future__ import annotations

from isaacgymenvs_lite.report.scalars import NOTHING, first_of, read_scalars
from tests.report.conftest import AMP, PPO


def test_every_scalar_over_frames_is_read(make_run) -> None:
    scalars = read_scalars(make_run(AMP) / "summaries")
    assert set(scalars) == set(AMP) - {"rewards/iter", "Episode/some"}
    style = scalars["info/disc_reward_mean"]
    assert style.values.tolist() == [0.25, 0.5, 0.75]
    assert style.frames.tolist() == [0, 100, 200]
    assert style.minutes.round(1).tolist() == [1.0, 2.0, 3.0]


def test_the_first_name_that_a_run_has_counts(make_run) -> None:
    scalars = read_scalars(make_run(PPO) / "summaries")
    tags = ("rewards/frame", "rewards/step")
    assert first_of(scalars, tags) is scalars["rewards/step"]
    assert first_of(scalars, ("rewards/frame",)) is NOTHING
    assert len(NOTHING) == 0


def test_a_resumed_run_is_one_run(write_events, tmp_path) -> None:
    """tests/benchmarks/test_learning_curve.py has the rest."""
    write_events(tmp_path, [1.0, 2.0, 3.0, 4.0, 5.0], poses={1: 0.5, 4: 0.25})
    write_events(tmp_path, [None, 13.0], first_epoch=2, start_s=99_000.0)
    scalars = read_scalars(tmp_path)
    assert scalars["episode_lengths/frame"].values.tolist() == [1.0, 2.0, 13.0]
    assert scalars["performance/total_fps"].minutes.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert scalars["imitation/pose_error_m"].values.tolist() == [0.5]
