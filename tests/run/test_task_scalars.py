from __future__ import annotations

import types

import pytest
import torch

from isaacgymenvs_lite.report.scalars import read_scalars
from isaacgymenvs_lite.run.metrics import TaskScalarsObserver
from tests.tiny import TINY_PPO, train_in


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


def test_diverged_simulations_are_counted_in_each_epoch_and_in_no_episode(task_scalars, agent):
    ended = torch.tensor([[0], [2]])

    def step(diverged: list[bool], done: torch.Tensor) -> None:
        work = {"work": torch.tensor([1.0, 10.0, 100.0])}
        infos = {"diverged": torch.tensor(diverged), "episode_cumulative": work}
        task_scalars.process_infos(infos, done)

    step([False, False, True], ended)
    step([True, False, True], NOBODY)
    task_scalars.after_print_stats(1000, 1, 1.0)
    step([False] * 3, torch.tensor([[2]]))
    task_scalars.after_print_stats(2000, 2, 2.0)
    assert agent.writer.scalars["sim/diverged"] == [(1000, 3), (2000, 0)]
    # The diverged episode is in no mean, and its work is not in the next one.
    assert agent.writer.scalars["episode_cumulative/work"] == [(1000, 1.0), (2000, 100.5)]


def test_the_terms_of_a_reward_are_means_over_environments_and_steps(task_scalars, agent):
    task = types.SimpleNamespace()
    agent.vec_env = types.SimpleNamespace(env=task)
    for up, effort in (([1.0, 3.0], [-1.0, 0.0]), ([4.0, 6.0], [-2.0, -3.0])):
        task.reward_terms = {"up": torch.tensor(up), "effort": torch.tensor(effort)}
        task_scalars.process_infos({}, NOBODY)
    task_scalars.after_print_stats(1000, 1, 1.0)
    task.reward_terms = {"up": torch.zeros(2), "effort": torch.ones(2)}
    task_scalars.process_infos({}, NOBODY)
    task_scalars.after_print_stats(2000, 2, 2.0)
    assert agent.writer.scalars == {
        "reward_terms/up": [(1000, 3.5), (2000, 0.0)],
        "reward_terms/effort": [(1000, -1.5), (2000, 1.0)],
    }


def test_a_training_writes_the_terms_whose_sum_is_the_reward(tmp_path):
    # The first episodes end with the epoch, after four steps.
    words = ["task=Ant", *TINY_PPO, "num_envs=8", "task.env.episodeLength=5", "max_iterations=1"]
    run = train_in(tmp_path, words)
    scalars = read_scalars(run / "summaries")
    terms = {tag: series for tag, series in scalars.items() if tag.startswith("reward_terms/")}
    assert len(terms) > 3
    per_step = sum(series.last for series in terms.values())
    assert 4 * per_step == pytest.approx(scalars["rewards/step"].last, rel=1e-4)
