"""The observers of a run beside a real agent."""

from __future__ import annotations

from typing import Any

import pytest
from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite.run.diagnostics import DiagnosticsObserver
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import MetricsObserver
from isaacgymenvs_lite.run.observers import MultiObserver


class Counter(AlgoObserver):
    """Counts the ends of episodes."""

    def __init__(self) -> None:
        super().__init__()
        self.episodes = self.falls = 0

    def process_infos(self, infos: Any, done_indices: Any) -> None:
        for row in done_indices.flatten().tolist():
            self.episodes += 1
            self.falls += int(infos["terminate"][row])


@pytest.fixture
def observed(make_agent, make_runner) -> tuple[Any, Counter, MetricsObserver, MeasurementObserver]:
    """An agent after three epochs of short episodes, with what observed it."""
    counter, figures = Counter(), MetricsObserver()

    def make_env(num_envs: int) -> Any:
        runner = make_runner("task.env.episodeLength=10", num_envs=num_envs)
        return runner.create_player().env

    imitation = MeasurementObserver(make_env, 1, 4)
    advice = DiagnosticsObserver(figures, imitation, max_episode_steps=10)
    agent = make_agent(
        "max_iterations=3",
        "task.env.episodeLength=10",
        "task.env.clipDeviation=0",  # else no episode lasts as long
        observer=MultiObserver([counter, imitation, figures, advice]),
    )
    agent.train()
    return agent, counter, figures, imitation


def test_the_fall_rate_is_that_of_the_last_episodes(observed):
    agent, counter, figures, _ = observed
    assert 0 < counter.episodes <= agent.games_to_track
    assert 0 < counter.falls < counter.episodes
    assert figures.latest.fall_rate == pytest.approx(counter.falls / counter.episodes)
    assert figures.latest.episode_steps == pytest.approx(agent.game_lengths.get_mean())
    assert figures.latest.epoch == 3


def test_the_discriminators_figures_are_the_agents(observed):
    agent, _, figures, _ = observed
    means = agent.train_info_means()
    assert figures.latest.style_reward == means["disc_reward_mean"]
    assert 0.0 <= figures.latest.disc_accuracy <= 1.0
    both = means["disc_agent_acc"] + means["disc_demo_acc"]
    assert figures.latest.disc_accuracy == pytest.approx(both / 2)


def test_a_measurement_knows_its_frame_and_how_far_the_clip_moves(observed):
    agent, _, _, imitation = observed
    assert imitation.last.imitation.pose_error_m > 0.0
    assert imitation.last_frame % (agent.horizon_length * agent.num_actors) == 0
    # arms and legs of the test's clip swing
    assert 0.02 < imitation.clip_spread_m < 0.3
