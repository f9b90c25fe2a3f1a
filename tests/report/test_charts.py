from __future__ import annotations

import math
import re

import numpy as np
import pytest

from isaacgymenvs_lite.report.charts import Chart, Line, main_charts, other_charts
from isaacgymenvs_lite.report.drawing import draw, short, thinned, ticks
from isaacgymenvs_lite.report.scalars import Series, read_scalars
from tests.report.conftest import AMP, PPO


def series(values) -> Series:
    frames = 100.0 * np.arange(len(values))
    return Series(frames, frames / 100.0, np.array(values, dtype=np.float64))


def test_charts_of_an_amp_run(make_run) -> None:
    scalars = read_scalars(make_run(AMP) / "summaries")
    charts = {chart.title: [line.label for line in chart.lines] for chart in main_charts(scalars)}
    assert charts == {
        "Task reward of an episode": ["task reward"],
        "Reward per step, by source": ["style", "task"],
        "Length of an episode, control steps": ["length"],
        "Pose error, m": ["pose error"],
        "Falls, share of the episodes": [
            "in training",
            "off the clip",
            "mean policy",
        ],
        "Tempo, multiple of the clip's": ["tempo"],
        "Discriminator accuracy, share of the samples": ["both", "policy", "clips"],
        "Learning rate": ["learning rate"],
        "Frames per second, learning included": ["frames/s"],
        "Goal: velocity_error_m_s": ["goal/velocity_error_m_s"],
        "Reward term, per step: effort": ["reward_terms/effort"],
        "Loss: a_loss": ["losses/a_loss"],
        "Loss: disc_loss": ["losses/disc_loss"],
    }
    by_title = {chart.title: chart for chart in main_charts(scalars)}
    _, task = by_title["Reward per step, by source"].lines
    assert task.series.values.tolist() == [0.5, 0.5, 0.5]
    *_, mean_policy = by_title["Falls, share of the episodes"].lines
    assert mean_policy.series.values.tolist() == [1.0, 0.5, 0.0]
    others = other_charts(scalars)
    assert [chart.title for chart in others] == ["info/epochs", "info/kl"]
    assert len(others[1].lines[0].series) == 2  # without the one that is no number


def test_charts_of_rl_games_own_agents(make_run) -> None:
    scalars = read_scalars(make_run(PPO) / "summaries")
    assert [chart.title for chart in main_charts(scalars)] == [
        "Task reward of an episode",
        "Length of an episode, control steps",
        "Learning rate",
        "Frames per second, learning included",
        "Loss: c_loss",
    ]
    assert other_charts(scalars) == []


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (-3.0, 9.0, [-2.5, 0.0, 2.5, 5.0, 7.5]),
        (0.0, 16.3e6, [0.0, 5e6, 10e6, 15e6]),
        (1e-5, 5.1e-5, [1e-5, 2e-5, 3e-5, 4e-5, 5e-5]),
    ],
)
def test_ticks_are_round(low, high, expected) -> None:
    assert ticks(low, high) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (0.25, "0.25"), (5e-5, "5e-05"), (-2e4, "-20k"), (1.5e6, "1.5M"), (2e9, "2G")],
)
def test_short_numbers(value, text) -> None:
    assert short(value) == text


def test_a_long_curve_is_thinned_to_means() -> None:
    found = thinned(series(np.arange(900.0)))
    assert len(found) == 300
    assert found.values[:2].tolist() == [1.0, 4.0]
    assert found.frames[-1] == 100 * 898.0
    odd = thinned(series(np.ones(1000)))
    assert len(odd) == 300
    assert odd.values == pytest.approx(np.ones(300))
    assert len(thinned(series(np.ones(300)))) == 300


@pytest.mark.parametrize("values", [[1.0], [2.0, 2.0], [0.0], [-1e9, 1e9], [1e-9, 2e-9]])
def test_any_curve_lies_within_the_frame(values) -> None:
    text = draw(Chart("</script><b>", (Line("a & </script>", series(values)),)))
    assert "nan" not in text
    assert text.count("</script>") == 1  # the element's own end
    points = text.split('points="')[1].split('"')[0].split()
    for point in points:
        x, y = (float(number) for number in point.split(","))
        assert 62 <= x <= 548
        assert 12 <= y <= 220
        assert math.isfinite(x + y)


def test_a_dashed_line_marks_where_a_run_was_resumed() -> None:
    curve = series(np.arange(901.0))
    resumed = Series(curve.frames, curve.minutes, curve.values, resumed_at=(45000.0, 0.0))
    text = draw(Chart("Loss", (Line("a", resumed), Line("b", resumed))))
    (x,) = re.findall(r'<line class="resumed" x1="([\d.]+)" x2="\1"', text)
    # Half-way between the first and the last of the points, each the mean of about three.
    assert float(x) == pytest.approx(0.5 * (62 + 548), abs=1.0)
    assert 'class="resumed"' not in draw(Chart("Loss", (Line("a", curve),)))


def test_charts_keep_where_a_run_was_resumed() -> None:
    curve = series([1.0, float("nan"), 3.0])
    tags = ("rewards/frame", "episode_lengths/frame", "info/fall_rate", "imitation/no_fall_share")
    run = {
        tag: Series(curve.frames, curve.minutes, curve.values, resumed_at=(100.0,)) for tag in tags
    }
    charts = main_charts(run)
    assert len(charts) == 3
    for chart in charts:
        assert all(line.series.resumed_at == (100.0,) for line in chart.lines), chart.title
        assert chart.resumed_at == [100.0]


def test_a_reward_of_one_a_step_is_left_out_and_measured_rewards_are_shown() -> None:
    lengths = {"episode_lengths/step": series([10, 20]), "rewards/step": series([10, 20])}
    titles = [chart.title for chart in main_charts(lengths)]
    assert titles == ["Length of an episode, control steps"]
    paid = {**lengths, "rewards/step": series([1, 2]), "measured/reward": series([3, 4])}
    labels = [line.label for line in main_charts(paid)[0].lines]
    assert labels == ["task reward", "mean policy"]
