from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from isaacgymenvs_lite.wrappers import Sb3VecEnvWrapper

NUM_ENVS = 6


@pytest.fixture
def env(make_cartpole) -> Sb3VecEnvWrapper:
    return Sb3VecEnvWrapper(make_cartpole())


def let_time_run_out(env: Sb3VecEnvWrapper, env_ids: slice = slice(None)):
    env.task.progress_buf[env_ids] = env.task.max_episode_length - 2
    return env.step(np.zeros((env.num_envs, env.task.num_actions), np.float32))


def test_it_speaks_numpy(env):
    observations = env.reset()
    assert (observations.shape, observations.dtype) == ((NUM_ENVS, 4), np.float32)
    observations, rewards, dones, infos = env.step(np.zeros((NUM_ENVS, 1)))
    assert (observations.shape, observations.dtype) == ((NUM_ENVS, 4), np.float32)
    assert (rewards.shape, rewards.dtype) == ((NUM_ENVS,), np.float32)
    assert (dones.shape, dones.dtype) == ((NUM_ENVS,), bool)
    assert infos == [{}] * NUM_ENVS


def test_a_time_limit_comes_with_the_last_observation(env):
    env.reset()
    observations, rewards, dones, infos = let_time_run_out(env, slice(2, 4))
    assert dones.tolist() == [False, False, True, True, False, False]
    assert infos[0] == {}
    info = infos[2]
    assert info["TimeLimit.truncated"] is True
    assert info["episode"]["l"] == 1
    assert info["episode"]["r"] == pytest.approx(rewards[2])
    assert 0.0 < info["episode"]["t"] < 60.0
    assert info["terminal_observation"].shape == (4,)
    assert not np.array_equal(info["terminal_observation"], observations[2])


def test_a_fall_is_no_truncation(env):
    env.reset()
    for _ in range(100):
        _, _, dones, infos = env.step(np.ones((NUM_ENVS, 1)))
        if dones.any():
            break
    (first, *_) = dones.nonzero()[0]
    assert infos[first]["TimeLimit.truncated"] is False
    cart, _, angle, _ = infos[first]["terminal_observation"]
    assert abs(cart) > 3.0 or abs(angle) > np.pi / 2


def test_its_episodes_are_those_that_vec_monitor_counts(env):
    with pytest.warns(UserWarning, match="already wrapped"):
        monitored = VecMonitor(env)
    monitored.reset()
    generator = np.random.default_rng(1)
    counted = 0
    for _ in range(120):
        env.step_async(5.0 * generator.uniform(-1.0, 1.0, (NUM_ENVS, 1)))
        *_, infos = monitored.step_wait()
        for info in infos:
            if "episode" in info:
                counted += 1
                # VecMonitor overwrites the entry in its copy of the info.
                assert info["episode"]["r"] == pytest.approx(_own_return(env, info), rel=1e-5)
    assert counted > NUM_ENVS


def _own_return(env: Sb3VecEnvWrapper, info: dict) -> float:
    episodes = env.stepper.last_step.episodes
    rows = env.stepper.last_step.final_observations["obs"][episodes.env_ids].numpy()
    (place,) = (rows == info["terminal_observation"]).all(axis=1).nonzero()[0]
    assert int(episodes.lengths[place]) == info["episode"]["l"]
    return float(episodes.returns[place])


def test_a_seed_repeats_the_first_observations(env):
    env.seed(3)
    first = env.reset()
    torch.rand(3)
    assert not np.array_equal(env.reset(), first)
    env.seed(3)
    assert np.array_equal(env.reset(), first)


def test_the_librarys_algorithms_and_evaluation_take_it(env, recwarn):
    normalized = VecNormalize(env)
    model = PPO("MlpPolicy", normalized, n_steps=4, batch_size=12, n_epochs=1, device="cpu")
    model.learn(48)
    assert not [w for w in recwarn.list if "Monitor" in str(w.message)]
    env.set_attr("max_episode_length", 20)
    _, lengths = evaluate_policy(model, normalized, 6, return_episode_rewards=True)
    assert all(2 < length <= 19 for length in lengths)
