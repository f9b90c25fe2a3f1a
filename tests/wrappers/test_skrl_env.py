from __future__ import annotations

import pytest
import torch

pytest.importorskip("skrl")
from skrl.envs.wrappers.torch import Wrapper

from isaacgymenvs_lite.wrappers import SkrlVecEnvWrapper

NUM_ENVS = 6


@pytest.fixture
def env(make_cartpole) -> SkrlVecEnvWrapper:
    return SkrlVecEnvWrapper(make_cartpole())


def let_time_run_out(env: SkrlVecEnvWrapper):
    env.task.progress_buf[2:4] = env.task.max_episode_length - 2
    return env.step(env.task.zero_actions())


def test_it_is_one_of_skrls(env):
    assert isinstance(env, Wrapper)
    assert (env.num_envs, env.num_agents, env.device) == (NUM_ENVS, 1, torch.device("cpu"))
    assert env.observation_space.shape == (4,)
    assert env.action_space.shape == (1,)
    assert env.state_space is None
    observations, infos = env.reset()
    assert observations.shape == (NUM_ENVS, 4)
    assert infos == {}
    assert env.state() is None


def test_falls_and_time_limits_are_columns(env):
    env.reset()
    observations, rewards, terminated, truncated, infos = let_time_run_out(env)
    assert rewards.shape == terminated.shape == truncated.shape == (NUM_ENVS, 1)
    assert truncated.flatten().tolist() == [False, False, True, True, False, False]
    assert not terminated.any()
    final = infos["final_observations"]
    assert not torch.equal(final[2], observations[2])
    assert torch.equal(final[0], observations[0])


def test_states_are_those_of_the_observations(make_cartpole):
    env = SkrlVecEnvWrapper(make_cartpole("task.env.asymmetric_observations=True"))
    assert env.state_space.shape == (4,)
    observations, _ = env.reset()
    assert torch.equal(env.state(), observations)
    observations, *_ = let_time_run_out(env)
    assert torch.equal(env.state(), observations)


def test_infos_for_all_environments_are_logged_by_trainers(make_task):
    env = SkrlVecEnvWrapper(make_task("AnymalTerrain"))
    env.reset()
    *_, infos = let_time_run_out(env)
    assert infos["episode"]["terrain_level"].numel() == 1
    amp = SkrlVecEnvWrapper(make_task("HumanoidAMP"))
    amp.reset()
    *_, infos = amp.step(amp.task.zero_actions())
    assert infos["amp_obs"].shape == (NUM_ENVS, 210)
