from __future__ import annotations

import pytest
import torch

pytest.importorskip("rsl_rl")
from rsl_rl.env import VecEnv

from isaacgymenvs_lite.wrappers import RslRlVecEnvWrapper

NUM_ENVS = 6


@pytest.fixture
def env(make_cartpole) -> RslRlVecEnvWrapper:
    return RslRlVecEnvWrapper(make_cartpole())


def test_it_is_one_of_rsl_rls(env):
    assert isinstance(env, VecEnv)
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (NUM_ENVS, 1, 500)
    observations = env.get_observations()
    assert observations.batch_size == (NUM_ENVS,)
    assert observations["policy"].shape == (NUM_ENVS, 4)
    assert list(observations.keys()) == ["policy"]


def test_a_step_gives_what_runners_read(env):
    before = env.get_observations()["policy"]
    observations, rewards, dones, extras = env.step(torch.ones(NUM_ENVS, 1))
    assert observations is env.get_observations()
    assert not torch.equal(observations["policy"], before)
    assert (rewards.shape, dones.shape, dones.dtype) == ((NUM_ENVS,), (NUM_ENVS,), torch.int64)
    assert extras["time_outs"].dtype == torch.bool


def test_the_length_buffer_is_the_tasks(env):
    """As `learn(init_at_random_ep_len=True)` does it."""
    env.episode_length_buf = torch.tensor([0, 498, 0, 498, 0, 498])
    _, _, dones, extras = env.step(env.task.zero_actions())
    assert dones.tolist() == [0, 1, 0, 1, 0, 1]
    assert extras["time_outs"].tolist() == [False, True, False, True, False, True]
    assert env.episode_length_buf.tolist() == [1, 0, 1, 0, 1, 0]


def test_a_fall_is_no_time_out(env):
    for _ in range(100):
        _, _, dones, extras = env.step(torch.ones(NUM_ENVS, 1))
        if dones.any():
            break
    assert dones.any()
    assert not extras["time_outs"].any()


def test_states_are_the_critics_group(make_cartpole):
    env = RslRlVecEnvWrapper(make_cartpole("task.env.asymmetric_observations=True"))
    assert env.get_observations()["critic"].shape == (NUM_ENVS, 4)
