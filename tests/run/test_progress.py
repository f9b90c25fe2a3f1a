from __future__ import annotations

import logging
import re
import sys
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.evaluation.evaluate import EvaluationResult
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import MetricsObserver
from isaacgymenvs_lite.run.observers import MultiObserver
from isaacgymenvs_lite.run.progress import ProgressObserver
from isaacgymenvs_lite.run.stop_request import StopRequest


class Progress(MultiObserver):
    """The observer of progress, after that of the metrics which it shows."""

    def __init__(self, stop: StopRequest, **kwargs: Any) -> None:
        self.stop, self.metrics = stop, MetricsObserver()
        progress = ProgressObserver(stop, self.metrics, **kwargs)
        super().__init__([self.metrics, progress])
        self.close = progress.close


def make_progress(agent: Any, **kwargs: Any) -> Progress:
    observer = Progress(**{"stop": StopRequest(), **kwargs})
    observer.after_init(agent)
    return observer


@pytest.fixture
def progress(agent, clock, monkeypatch) -> Progress:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    return make_progress(agent, line_interval_s=10.0)


def end_epoch(observer: Progress, clock: Any, epoch: int, seconds: float) -> None:
    clock.now_s += seconds
    observer.after_print_stats(0, epoch, 0.0)


def finish_episodes(progress: Progress, agent: Any) -> None:
    """Two episodes, of which one fell."""
    agent.game_lengths.update(torch.tensor([[100.0], [110.0]]))
    agent.game_rewards.update(torch.tensor([[5.0], [6.0]]))
    progress.metrics.process_infos(
        {"terminate": torch.tensor([True, False])}, torch.tensor([[0], [1]])
    )


def test_a_line_of_progress(progress, agent, clock, caplog):
    finish_episodes(progress, agent)
    with caplog.at_level(logging.INFO):
        end_epoch(progress, clock, 5, 2.0)
    # 15 epochs of 2 s are left; 1000 frames in 2 s
    assert caplog.messages == [
        "epoch 5/20, ETA 0:00:30, fps 500, episode length 105, falls 50%, style reward 0.46,"
        " disc accuracy 80%"
    ]


def test_a_task_reward_is_shown_where_it_counts(progress, agent, clock, caplog):
    agent.config["task_reward_w"] = 0.5
    finish_episodes(progress, agent)
    with caplog.at_level(logging.INFO):
        end_epoch(progress, clock, 5, 2.0)
    assert "falls 50%, reward 5.50, style reward 0.46" in caplog.messages[0]


def test_successes_are_shown(progress, agent, clock, caplog):
    successes = {"at_goal": torch.tensor([1.0, 0.0, 0.0])}
    progress.metrics.process_infos({"successes": successes}, torch.tensor([[0], [1]]))
    with caplog.at_level(logging.INFO):
        end_epoch(progress, clock, 5, 2.0)
    assert ", at goal 0.50, " in caplog.messages[0]


def test_lines_come_at_intervals(progress, clock, caplog):
    with caplog.at_level(logging.INFO):
        for epoch in range(1, 13):
            end_epoch(progress, clock, epoch, 2.0)
    # the first at once, then every ten seconds: after 2, 12 and 22 s; once an estimate
    assert [message.split(",")[0] for message in caplog.messages] == [
        "epoch 1/20",
        "epoch 6/20",
        "10 more epochs take about 20 seconds on this machine",
        "epoch 11/20",
    ]
    assert "ETA 0:00:18" in caplog.messages[-1]


def test_a_resumed_training_counts_its_own_epochs(progress, agent, clock, caplog):
    agent.max_epochs = 1010
    with caplog.at_level(logging.INFO):
        end_epoch(progress, clock, 1001, 1.0)
        end_epoch(progress, clock, 1002, 11.0)
    # two epochs in 12 s, eight left
    assert "ETA 0:00:48" in caplog.messages[-1]


def test_the_pose_error_is_shown_once_known(agent, clock, result, monkeypatch, caplog):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    imitation = MeasurementObserver(lambda num_envs: None, 0, 16)
    observer = make_progress(agent, imitation=imitation, line_interval_s=0.0)
    with caplog.at_level(logging.INFO):
        end_epoch(observer, clock, 1, 1.0)
        imitation.last = result
        end_epoch(observer, clock, 2, 1.0)
    assert "pose error" not in caplog.messages[0]
    assert caplog.messages[1].endswith("pose error 0.123 m, tempo 1.02, motion shown 87%")


def test_measured_successes_are_shown(agent, clock, monkeypatch, caplog):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    measured = MeasurementObserver(lambda num_envs: None, 0, 16)
    measured.last = EvaluationResult(16, 12.5, 90.5, None, None, successes={"at_goal": 0.25})
    observer = make_progress(agent, imitation=measured)
    with caplog.at_level(logging.INFO):
        end_epoch(observer, clock, 1, 1.0)
    assert caplog.messages[0].endswith("reward 12.50, measured falls 0%, measured at goal 0.25")


def test_a_request_makes_the_epoch_the_last_one(agent, clock, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    stop = StopRequest()
    observer = make_progress(agent, stop=stop)
    end_epoch(observer, clock, 1, 1.0)
    assert agent.max_epochs == 20
    stop.requested = True
    end_epoch(observer, clock, 2, 1.0)
    assert agent.max_epochs == 2


def test_a_terminal_gets_a_bar(progress, agent, clock, monkeypatch, caplog, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    agent.game_lengths.update(torch.tensor([[100.0]]))
    agent.game_rewards.update(torch.tensor([[5.0]]))
    with caplog.at_level(logging.INFO):
        for epoch in (11, 12, 13):
            end_epoch(progress, clock, epoch, 1.0)
    assert caplog.messages == []
    progress.close()
    shown = capsys.readouterr().err
    assert re.findall(r"\d+/20", shown)[0] == "10/20"  # epochs of a resumed run count
    assert re.findall(r"\d+/20", shown)[-1] == "13/20"
    assert "episode length=100" in shown
    assert "style reward=0.46, disc accuracy=80%, fps=1,000" in shown
