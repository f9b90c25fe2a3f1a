from __future__ import annotations

import logging
import sys
import types
from typing import Any

import numpy as np
import pytest
import torch
from rl_games.algos_torch.torch_ext import AverageMeter
from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite import observers
from isaacgymenvs_lite.imitation import ImitationResult
from isaacgymenvs_lite.learning.evaluation import EvaluationResult
from isaacgymenvs_lite.observers import (
    ImitationObserver,
    MultiObserver,
    ProgressObserver,
    TaskScalarsObserver,
)
from isaacgymenvs_lite.stopping import StopRequest


class Writer:
    """Keeps scalars: {tag: [(x, value), ...]}."""

    def __init__(self) -> None:
        self.scalars: dict[str, list[tuple[float, float]]] = {}

    def add_scalar(self, tag: str, value: float, x: float) -> None:
        self.scalars.setdefault(tag, []).append((x, value))


class Agent:
    """As much of an agent as observers look at."""

    def __init__(self) -> None:
        self.writer = Writer()
        self.games_to_track = 3
        self.max_epochs = 20
        self.curr_frames = 1000
        self.game_lengths = AverageMeter(1, 100)
        self.game_rewards = AverageMeter(1, 100)

    def train_info_means(self) -> dict[str, float]:
        return {"disc_reward_mean": 0.4567}


@pytest.fixture
def agent() -> Agent:
    return Agent()


@pytest.fixture
def clock(monkeypatch) -> Any:
    """Seconds that pass only when a test says so."""
    fake = types.SimpleNamespace(now_s=100.0)
    fake.monotonic = lambda: fake.now_s
    monkeypatch.setattr(observers, "time", fake)
    return fake


# --- MultiObserver ----------------------------------------------------------------------------


def test_calls_reach_all_observers_in_order():
    heard = []

    class Listener(AlgoObserver):
        def __init__(self, name: str) -> None:
            super().__init__()
            self.name = name

        def before_init(self, *args: Any) -> None:
            heard.append((self.name, "before_init", args))

        def after_init(self, *args: Any) -> None:
            heard.append((self.name, "after_init", args))

        def process_infos(self, *args: Any) -> None:
            heard.append((self.name, "process_infos", args))

        def after_steps(self) -> None:
            heard.append((self.name, "after_steps", ()))

        def after_clear_stats(self) -> None:
            heard.append((self.name, "after_clear_stats", ()))

        def after_print_stats(self, *args: Any) -> None:
            heard.append((self.name, "after_print_stats", args))

    class Deaf(AlgoObserver):
        """rl_games' base class has no after_clear_stats."""

    both = MultiObserver([Listener("a"), Deaf(), Listener("b")])
    calls = {
        "before_init": ("run", {}, "name"),
        "after_init": ("algo",),
        "process_infos": ({"x": 1}, torch.tensor([0])),
        "after_steps": (),
        "after_clear_stats": (),
        "after_print_stats": (10, 2, 3.0),
    }
    for name, args in calls.items():
        getattr(both, name)(*args)
    assert heard == [(who, name, args) for name, args in calls.items() for who in ("a", "b")]


# --- TaskScalarsObserver ----------------------------------------------------------------------


@pytest.fixture
def task_scalars(agent) -> TaskScalarsObserver:
    observer = TaskScalarsObserver()
    observer.after_init(agent)
    return observer


NOBODY = torch.zeros(0, 1, dtype=torch.int64)


def test_scalars_of_infos_are_written_over_three_axes(task_scalars, agent):
    infos = {
        "diverged": 3,
        "rate": torch.tensor(0.25),
        "time_outs": torch.zeros(4),  # no scalar
        "reward": {"style": 0.5, "parts": {"feet": 2}},
        "names": "text",
    }
    task_scalars.process_infos({"diverged": 1}, NOBODY)
    task_scalars.process_infos(infos, NOBODY)
    task_scalars.after_print_stats(1000, 7, 12.5)
    expected = {"diverged": 3.0, "rate": 0.25, "reward/style": 0.5, "reward/parts/feet": 2.0}
    assert agent.writer.scalars == {
        f"{key}/{axis}": [(x, value)]
        for key, value in expected.items()
        for axis, x in (("frame", 1000), ("iter", 7), ("time", 12.5))
    }


def test_means_of_finished_episodes(task_scalars, agent):
    task_scalars.process_infos({"episode": {"height": torch.tensor([1.0, 2.0])}}, NOBODY)
    task_scalars.process_infos({"episode": {"height": torch.tensor(6.0)}}, NOBODY)
    task_scalars.after_print_stats(1000, 7, 12.5)
    assert agent.writer.scalars == {"Episode/height": [(7, 3.0)]}
    # and they are forgotten
    task_scalars.process_infos({"episode": {"height": 5.0}}, NOBODY)
    task_scalars.after_print_stats(2000, 8, 13.0)
    assert agent.writer.scalars["Episode/height"][1:] == [(8, 5.0)]


def test_sums_over_episodes(task_scalars, agent):
    def step(values: list[float], done: list[int]) -> None:
        ids = torch.tensor(done, dtype=torch.int64).view(-1, 1)  # as rl_games gives them
        task_scalars.process_infos({"episode_cumulative": {"work": torch.tensor(values)}}, ids)

    step([1.0, 10.0], [])
    step([2.0, 20.0], [0])  # environment 0: 3
    step([4.0, 40.0], [1])  # environment 1: 70
    step([8.0, 80.0], [0, 1])  # 12 and 80
    task_scalars.after_print_stats(1000, 7, 12.5)
    # of the last three episodes: 70, 12, 80
    assert agent.writer.scalars == {
        "episode_cumulative/work": [(1000, 54.0)],
        "episode_cumulative_min/work_min": [(1000, 12.0)],
        "episode_cumulative_max/work_max": [(1000, 80.0)],
    }


def test_what_the_task_gave_is_not_changed(task_scalars):
    given = torch.tensor([1.0, 2.0])
    for _ in range(3):
        task_scalars.process_infos({"episode_cumulative": {"work": given}}, torch.tensor([[0]]))
    assert given.tolist() == [1.0, 2.0]


def test_infos_must_be_a_dictionary(task_scalars):
    with pytest.raises(TypeError, match="list"):
        task_scalars.process_infos([], NOBODY)


# --- ImitationObserver ------------------------------------------------------------------------

IMITATION = ImitationResult(
    pose_error_m=0.123,
    per_episode=np.full(16, 0.123),
    nearest_clip=np.zeros(16, dtype=np.int64),
    tempo=1.02,
    no_fall_share=0.9,
    mean_episode_steps=90.5,
    num_episodes=16,
)
RESULT = EvaluationResult(16, 100.0, 90.5, 0.3, IMITATION)


class TimedImitation(ImitationObserver):
    """An evaluation that takes `cost_s` of the fake clock."""

    def __init__(self, clock: Any, frequency: int, cost_s: float) -> None:
        super().__init__(lambda num_envs: None, frequency, 16)
        self.clock, self.cost_s, self.evaluated_at = clock, cost_s, []

    def _evaluate(self) -> EvaluationResult:
        self.clock.now_s += self.cost_s
        self.evaluated_at.append(self.clock.now_s)
        return RESULT


def train(observer: TimedImitation, agent: Agent, epochs: int, epoch_s: float) -> None:
    """Epochs of a given length; after each the share of the time is within the budget."""
    observer.after_init(agent)
    start_s = observer.clock.now_s
    for epoch in range(1, epochs + 1):
        observer.clock.now_s += epoch_s
        observer.after_print_stats(1000 * epoch, epoch, 0.0)
        count = len(observer.evaluated_at)
        spent_s = count * observer.cost_s
        trained_s = observer.clock.now_s - start_s - spent_s
        # What the first one costs is not known before.
        assert count <= 1 or spent_s <= 0.02 * trained_s + 1e-6, epoch


def test_cheap_evaluations_come_every_so_many_epochs(clock, agent):
    observer = TimedImitation(clock, 10, 0.1)
    train(observer, agent, epochs=100, epoch_s=2.0)
    assert len(observer.evaluated_at) == 10
    tags = agent.writer.scalars
    assert tags["imitation/pose_error_m"][0] == (10_000, 0.123)
    assert [x for x, _ in tags["imitation/pose_error_m"]] == list(range(10_000, 101_000, 10_000))
    assert tags["imitation/no_fall_share"][0] == (10_000, 0.9)
    assert tags["imitation/tempo"][0] == (10_000, 1.02)
    assert tags["imitation/episode_steps"][0] == (10_000, 90.5)
    assert observer.last is RESULT


def test_dear_evaluations_are_put_off(clock, agent):
    observer = TimedImitation(clock, 10, 5.0)
    train(observer, agent, epochs=1000, epoch_s=1.0)
    # one per 250 s of training, the first one after 10 epochs
    assert 3 <= len(observer.evaluated_at) <= 5


def test_an_evaluation_that_was_put_off_comes_as_soon_as_it_may(clock, agent):
    observer = TimedImitation(clock, 100, 3.0)
    train(observer, agent, epochs=350, epoch_s=1.0)
    # after 100 s; due again after 200, allowed after 300: 6 s of 300
    after_s = [at - 100.0 for at in observer.evaluated_at]
    assert after_s[0] == pytest.approx(103.0)
    assert after_s[1] == pytest.approx(300.0 + 3.0 + 3.0, abs=1.0)


def test_frequency_zero_means_never(clock, agent):
    observer = TimedImitation(clock, 0, 0.0)
    train(observer, agent, epochs=50, epoch_s=100.0)
    assert observer.evaluated_at == []
    assert agent.writer.scalars == {}


def test_a_task_without_references_has_no_pose_error(clock, agent):
    observer = TimedImitation(clock, 1, 0.0)
    observer._evaluate = lambda: EvaluationResult(16, 100.0, 90.5, None, None)
    train(observer, agent, epochs=1, epoch_s=1.0)
    assert set(agent.writer.scalars) == {"imitation/episode_steps"}


# --- ProgressObserver -------------------------------------------------------------------------


@pytest.fixture
def progress(agent, clock, monkeypatch) -> ProgressObserver:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    observer = ProgressObserver(StopRequest(), line_interval_s=10.0)
    observer.after_init(agent)
    return observer


def tell(observer: ProgressObserver, clock: Any, epoch: int, seconds: float) -> None:
    clock.now_s += seconds
    observer.after_print_stats(0, epoch, 0.0)


def test_a_line_of_progress(progress, agent, clock, caplog):
    agent.game_lengths.update(torch.tensor([[100.0], [110.0]]))
    agent.game_rewards.update(torch.tensor([[5.0], [6.0]]))
    with caplog.at_level(logging.INFO):
        tell(progress, clock, 5, 2.0)
    # 15 epochs of 2 s are left; 1000 frames in 2 s
    assert caplog.messages == [
        "epoch 5/20, ETA 0:00:30, fps 500, episode length 105, reward 5.50, style reward 0.457"
    ]


def test_lines_come_at_intervals(progress, clock, caplog):
    with caplog.at_level(logging.INFO):
        for epoch in range(1, 13):
            tell(progress, clock, epoch, 2.0)
    # the first at once, then every ten seconds: after 2, 12 and 22 s
    assert [message.split(",")[0] for message in caplog.messages] == [
        "epoch 1/20",
        "epoch 6/20",
        "epoch 11/20",
    ]
    assert "ETA 0:00:18" in caplog.messages[-1]


def test_without_a_last_epoch_there_is_no_eta(progress, agent, clock, caplog):
    agent.max_epochs = -1
    with caplog.at_level(logging.INFO):
        tell(progress, clock, 3, 1.0)
    assert caplog.messages[0].startswith("epoch 3, fps 1,000")


def test_a_resumed_training_counts_its_own_epochs(progress, agent, clock, caplog):
    agent.max_epochs = 1010
    with caplog.at_level(logging.INFO):
        tell(progress, clock, 1001, 1.0)
        tell(progress, clock, 1002, 11.0)
    # two epochs in 12 s, eight left
    assert "ETA 0:00:48" in caplog.messages[-1]


def test_the_pose_error_is_shown_once_known(agent, clock, monkeypatch, caplog):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    imitation = ImitationObserver(lambda num_envs: None, 0, 16)
    observer = ProgressObserver(StopRequest(), imitation, line_interval_s=0.0)
    observer.after_init(agent)
    with caplog.at_level(logging.INFO):
        tell(observer, clock, 1, 1.0)
        imitation.last = RESULT
        tell(observer, clock, 2, 1.0)
    assert "pose error" not in caplog.messages[0]
    assert caplog.messages[1].endswith("pose error 0.123 m")


def test_a_request_makes_the_epoch_the_last_one(agent, clock, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    stop = StopRequest()
    observer = ProgressObserver(stop)
    observer.after_init(agent)
    tell(observer, clock, 1, 1.0)
    assert agent.max_epochs == 20
    stop.requested = True
    tell(observer, clock, 2, 1.0)
    assert agent.max_epochs == 2


def test_a_terminal_gets_a_bar(progress, agent, clock, monkeypatch, caplog, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    agent.game_lengths.update(torch.tensor([[100.0]]))
    agent.game_rewards.update(torch.tensor([[5.0]]))
    with caplog.at_level(logging.INFO):
        for epoch in (11, 12, 13):
            tell(progress, clock, epoch, 1.0)
    assert caplog.messages == []
    assert progress._bar is not None
    assert progress._bar.n == 13
    assert progress._bar.total == 20
    assert progress._bar.initial == 10
    progress.close()
    shown = capsys.readouterr().err
    assert "13/20" in shown
    assert "episode length=100" in shown


def test_closing_without_a_bar_is_harmless(progress):
    progress.close()
