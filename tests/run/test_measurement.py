from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.evaluation.evaluate import EvaluationResult
from isaacgymenvs_lite.evaluation.pose_error import ReferencePoses
from isaacgymenvs_lite.run.measurement import MeasurementObserver, clip_spread_m


class TimedImitation(MeasurementObserver):
    """An evaluation that takes `cost_s` of the fake clock."""

    def __init__(self, clock: Any, result: EvaluationResult, frequency: int, cost_s: float) -> None:
        super().__init__(lambda num_envs: None, frequency, 16)
        self.clock, self.result, self.cost_s = clock, result, cost_s
        self.evaluated_at: list[float] = []

    def measure(self) -> EvaluationResult:
        self.clock.now_s += self.cost_s
        self.evaluated_at.append(self.clock.now_s)
        return self.result


def train(observer: TimedImitation, agent: Any, epochs: int, epoch_s: float) -> None:
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


def test_cheap_evaluations_come_every_so_many_epochs(clock, agent, result):
    observer = TimedImitation(clock, result, 10, 0.1)
    train(observer, agent, epochs=100, epoch_s=2.0)
    assert len(observer.evaluated_at) == 10
    tags = agent.writer.scalars
    assert tags["imitation/pose_error_m"][0] == (10_000, 0.123)
    assert [x for x, _ in tags["imitation/pose_error_m"]] == list(range(10_000, 101_000, 10_000))
    assert tags["imitation/no_fall_share"][0] == (10_000, 0.9)
    assert tags["imitation/tempo"][0] == (10_000, 1.02)
    assert tags["imitation/motion_shown"][0] == (10_000, 0.87)
    assert tags["imitation/episode_steps"][0] == (10_000, 90.5)
    assert observer.last is result
    assert observer.last_frame == 100_000


def test_errors_of_a_goal_are_written(clock, agent, result):
    result = dataclasses.replace(result, goal_errors={"velocity_error_m_s": 0.2})
    train(TimedImitation(clock, result, 10, 0.1), agent, epochs=10, epoch_s=2.0)
    assert agent.writer.scalars["goal/velocity_error_m_s"] == [(10_000, 0.2)]


def test_dear_evaluations_are_put_off(clock, agent, result):
    observer = TimedImitation(clock, result, 10, 5.0)
    train(observer, agent, epochs=1000, epoch_s=1.0)
    # one per 250 s of training, the first one after 10 epochs
    assert 3 <= len(observer.evaluated_at) <= 5


def test_frequency_zero_means_never(clock, agent, result):
    observer = TimedImitation(clock, result, 0, 0.0)
    train(observer, agent, epochs=50, epoch_s=100.0)
    assert observer.evaluated_at == []
    assert agent.writer.scalars == {}


def test_a_task_without_references_has_no_pose_error(clock, agent, result):
    observer = TimedImitation(clock, result, 1, 0.0)
    observer.measure = lambda: EvaluationResult(16, 100.0, 90.5, None, None, falls=0.25)
    train(observer, agent, epochs=1, epoch_s=1.0)
    assert {tag: value for tag, [(_, value)] in agent.writer.scalars.items()} == {
        "measured/reward": 100.0,
        "measured/episode_steps": 90.5,
        "measured/fall_rate": 0.25,
    }


@pytest.mark.parametrize(
    ("last", "word"), [(40.0, "less than the best one (50, after epoch 2)"), (49, "")]
)
def test_the_highest_reward_is_the_best_checkpoint(clock, agent, result, last, word):
    observer = TimedImitation(clock, result, 1, 0.0)
    observer.chooses_best = True
    saved: list[int] = []
    agent.save_best = lambda: saved.append(observer.best_epoch)
    rewards = iter([10.0, 50.0, 30.0, last])
    observer.measure = lambda: EvaluationResult(16, next(rewards), 90.5, None, None)
    train(observer, agent, epochs=4, epoch_s=1.0)
    assert agent.best_is_measured
    assert saved == [1, 2]
    assert (observer.best_reward, observer.best_epoch) == (50.0, 2)
    assert observer.worsened().endswith(word)
    assert bool(observer.worsened()) == bool(word)


NO_RESULT = EvaluationResult(16, 0.0, 90.5, None, None)


@pytest.mark.parametrize(
    ("measured", "best", "word"),
    [
        # pairs of success and reward
        ([(0.5, 1.0), (0.4, 9.0)], 1, "succeeds less often than the best one, after epoch 1"),
        ([(0.5, 9.0), (0.6, 1.0)], 2, ""),
        ([(0.5, 9.0), (0.5, 1.0)], 1, ""),
        ([(0.5, 1.0), (0.5, 9.0), (0.46, 9.0)], 2, ""),
        ([(0.0, 1.0), (0.0, 2.0)], 2, ""),
    ],
)
def test_success_chooses_before_the_reward(clock, agent, measured, best, word):
    observer = TimedImitation(clock, NO_RESULT, 1, 0.0)
    observer.chooses_best = True
    saved: list[int] = []
    agent.save_best = lambda: saved.append(observer.best_epoch)
    results = [
        dataclasses.replace(NO_RESULT, reward=reward, successes={"at_goal": success})
        for success, reward in measured
    ]
    observer.measure = iter(results).__next__
    train(observer, agent, epochs=len(measured), epoch_s=1.0)
    assert saved[-1] == observer.best_epoch == best
    assert (observer.best_success, observer.best_reward) == measured[best - 1]
    assert observer.worsened().endswith(word)
    assert bool(observer.worsened()) == bool(word)
    scalars = [value for _, value in agent.writer.scalars["success/measured_at_goal"]]
    assert scalars == [success for success, _ in measured]


def test_spread_is_the_mean_distance_from_the_average_pose():
    # body 1 at x = 0 and 0.4 m, the root at the origin: 0.2 m and 0 m from the average
    moving = torch.tensor([[[0.0, 0, 0], [0.0, 0, 0]], [[0.0, 0, 0], [0.4, 0, 0]]])
    assert clip_spread_m(ReferencePoses([moving])) == pytest.approx(0.1)


def test_the_best_pose_error_of_a_run(clock, agent, result):
    observer = TimedImitation(clock, result, 1, 0.0)
    assert observer.best_pose_error_m is None
    for error in (math.nan, 0.3, 0.1, 0.2):
        observer.result = dataclasses.replace(
            result, imitation=dataclasses.replace(result.imitation, pose_error_m=error)
        )
        train(observer, agent, epochs=1, epoch_s=1.0)
    assert observer.best_pose_error_m == 0.1


@pytest.mark.parametrize(("frequency", "evaluations"), [(2, 2), (3, 1), (5, 1)])
def test_the_last_policy_is_evaluated_once(frequency, evaluations, clock, agent, result):
    observer = TimedImitation(clock, result, frequency, 0.0)
    observer.evaluate_end()
    assert observer.evaluated_at == []  # nothing was trained
    train(observer, agent, epochs=3, epoch_s=1.0)
    observer.evaluate_end()
    observer.evaluate_end()
    assert len(observer.evaluated_at) == evaluations
    assert observer.best_pose_error_m == 0.123
    # under the frame of the last epoch, as if it had been due
    assert agent.writer.scalars["imitation/pose_error_m"][-1] == (3000, 0.123)
