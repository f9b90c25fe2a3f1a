"""rl_games' PPO and its player on a humanoid that resets its episodes on request."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

PPO = (
    "train.params.algo.name=a2c_continuous",
    "train.params.model.name=continuous_a2c_logstd",
    "train.params.network.name=actor_critic",
    "task.env.episodeLength=12",
    "task.env.enableEarlyTermination=False",
)


@pytest.fixture
def player(make_runner: Callable[..., Any]) -> Any:
    return make_runner(*PPO, "+train.params.config.player.games_num=16").create_player()


def test_it_plays_whole_episodes(player) -> None:
    player.run()
    assert player.result.num_episodes == 16
    # The step that ends an episode at the limit is the one before the last; a reward of 1 in each.
    assert player.result.steps == 11
    assert player.result.reward == pytest.approx(11.0)


def test_mean_actions_by_default(player) -> None:
    obs = player.env.reset()
    assert (player.act(obs) == player.act(obs)).all()
    player.is_deterministic = False
    assert (player.act(obs) != player.act(obs)).any()


def test_training_sees_one_episode_after_another(make_agent) -> None:
    agent = make_agent(*PPO, "train.params.config.horizon_length=30", "max_iterations=1")
    lengths: list[int] = []
    step = agent.vec_env.env.step

    def noting(actions):
        lengths.extend(agent.vec_env.env.progress_buf.tolist())
        return step(actions)

    agent.vec_env.env.step = noting
    agent.train()
    # 8 environments, 30 steps: progress before a step is 0 to 10, never beyond the limit.
    assert sorted(set(lengths)) == list(range(11))
