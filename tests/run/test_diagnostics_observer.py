from __future__ import annotations

import logging

import pytest
import torch

from isaacgymenvs_lite.run import (
    DiagnosticsObserver,
    ImitationObserver,
    MetricsObserver,
)
from isaacgymenvs_lite.run.history import Measurement


@pytest.fixture
def figures(agent) -> MetricsObserver:
    observer = MetricsObserver()
    observer.after_init(agent)
    return observer


@pytest.fixture
def imitation() -> ImitationObserver:
    return ImitationObserver(lambda num_envs: None, 0, 16)


@pytest.fixture
def advice(agent, clock, figures, imitation) -> DiagnosticsObserver:
    observer = DiagnosticsObserver(figures, imitation, max_episode_steps=300)
    observer.after_init(agent)
    return observer


def epoch(figures: MetricsObserver, advice: DiagnosticsObserver, number: int, frame: int) -> None:
    for observer in (figures, advice):
        observer.after_print_stats(frame, number, 0.0)


def test_a_discriminator_that_has_won_is_seen(advice, figures, agent, clock, caplog):
    agent.train_info = {
        "disc_reward_mean": 0.02,
        "disc_agent_acc": 0.999,
        "disc_demo_acc": 1.0,
    }
    agent.game_lengths.update(torch.tensor([[6.0]]))
    with caplog.at_level(logging.INFO):
        for number in range(1, 200):
            clock.now_s += 4.0
            figures.process_infos(
                {"terminate": torch.ones(4, dtype=torch.bool)}, torch.arange(4).view(-1, 1)
            )
            epoch(figures, advice, number, 16384 * number)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "disc_grad_penalty=10 (now 5)" in caplog.messages[0]
    assert [text[:2] for text in agent.writer.texts] == [("advice", caplog.messages[0])]


def test_each_measurement_is_passed_on_once(advice, figures, imitation, result):
    epoch(figures, advice, 1, 1000)
    imitation.last, imitation.last_frame, imitation.clip_spread_m = result, 2000, 0.1
    epoch(figures, advice, 2, 2000)
    epoch(figures, advice, 3, 3000)
    imitation.last_frame = 4000
    epoch(figures, advice, 4, 4000)
    assert advice._advisor._history.measurements == [
        Measurement(2000, 0.123, 1.02, 0.9, 0.1),
        Measurement(4000, 0.123, 1.02, 0.9, 0.1),
    ]


def test_a_task_without_references_is_watched_as_well(agent, figures):
    observer = DiagnosticsObserver(figures, None, max_episode_steps=300)
    observer.after_init(agent)
    epoch(figures, observer, 1, 1000)
    assert observer._advisor._history.newest.epoch == 1


def test_nothing_is_said_before_an_epoch_has_ended(advice, caplog):
    with caplog.at_level(logging.INFO):
        advice.after_print_stats(1000, 1, 0.0)
    assert caplog.messages == []
