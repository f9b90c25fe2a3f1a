from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import vector as vector_wrappers

import isaacgymenvs_lite  # registers the tasks
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.wrappers.gymnasium_env import GymnasiumVectorEnv

NUM_ENVS = 6
assert isaacgymenvs_lite


@pytest.fixture
def make_envs():
    """Return `make_envs(task="Cartpole", **keys)`, made as a user of Gymnasium does."""
    made = []

    def make(task: str = "Cartpole", **keys) -> VectorEnv:
        keys = {"num_envs": NUM_ENVS, "num_threads": 1, **keys}
        made.append(gymnasium.make_vec(f"IsaacGymEnvsLite/{task}-v0", **keys))
        return made[-1]

    yield make
    for envs in made:
        envs.close()


def let_time_run_out(envs: VectorEnv, env_ids: slice = slice(None)) -> tuple:
    envs.unwrapped.task.progress_buf[env_ids] = envs.unwrapped.task.max_episode_length - 2
    return envs.step(np.zeros(envs.action_space.shape, np.float32))


def test_it_meets_its_spaces(make_envs, recwarn):
    envs = make_envs()
    assert isinstance(envs, GymnasiumVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert envs.metadata["render_fps"] == 60
    assert envs.spec.id == "IsaacGymEnvsLite/Cartpole-v0"
    assert envs.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observations, infos = envs.reset(seed=1)
    assert infos == {}
    for _ in range(40):
        assert observations in envs.observation_space
        assert observations.dtype == np.float32
        observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
        assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float32, bool, bool)
        assert rewards.shape == terminated.shape == truncated.shape == (NUM_ENVS,)
        assert all(name.startswith(("final", "_final")) for name in infos)
    assert not recwarn.list


def test_the_end_of_an_episode_is_in_the_infos(make_envs):
    envs = make_envs()
    envs.reset(seed=1)
    before = envs.unwrapped.task.obs_buf.numpy().copy()
    observations, _, terminated, truncated, infos = let_time_run_out(envs, slice(2, 4))
    ended = [False, False, True, True, False, False]
    assert truncated.tolist() == ended
    assert not terminated.any()
    assert infos["_final_obs"].tolist() == infos["_final_info"].tolist() == ended
    assert [row is not None for row in infos["final_obs"]] == ended
    for env_id in (2, 3):
        last = infos["final_obs"][env_id]
        # One step after its last state, not the start of the next episode.
        assert last[0] == pytest.approx(before[env_id, 0] + 0.0166 * last[1], abs=1e-3)
        assert not np.allclose(last, observations[env_id])


def test_some_environments_can_be_reset(make_envs):
    envs = make_envs()
    envs.reset(seed=1)
    before, *_ = envs.step(envs.action_space.sample())
    mask = np.array([True, False, False, False, False, True])
    after, _ = envs.reset(options={"reset_mask": mask})
    assert np.array_equal(after[~mask], before[~mask])
    assert not np.array_equal(after[mask], before[mask])
    with pytest.raises(ConfigError, match=r"got bool \(2,\), expected a numpy array of \(6,\)"):
        envs.reset(options={"reset_mask": mask[:2]})
    with pytest.raises(ConfigError, match="at least one True"):
        envs.reset(options={"reset_mask": np.zeros(6, bool)})


def test_a_seed_repeats_a_course(make_envs):
    def course(envs: VectorEnv, seed: int) -> np.ndarray:
        rows = [envs.reset(seed=seed)[0]]
        rows += [let_time_run_out(envs)[0] for _ in range(3)]
        return np.stack(rows)

    envs = make_envs()
    first = course(envs, 3)
    assert np.array_equal(course(envs, 3), first)
    assert np.array_equal(course(make_envs(), 3), first)
    assert not np.array_equal(course(envs, 4), first)


def test_gymnasiums_wrappers_go_around_it(make_envs):
    envs = vector_wrappers.RecordEpisodeStatistics(make_envs())
    envs = vector_wrappers.ClipAction(envs)
    envs = vector_wrappers.ClipReward(envs, 0.0, 1.0)
    envs.reset(seed=1)
    lengths = []
    for _ in range(60):
        *_, infos = envs.step(5.0 * envs.action_space.sample())
        if "episode" in infos:
            lengths += infos["episode"]["l"][infos["_episode"]].tolist()
            assert infos["final_obs"][infos["_final_obs"]][0].shape == (4,)
    assert lengths
    assert all(1 < length < 60 for length in lengths)


def test_it_draws_each_environment(gl, make_envs):
    envs = make_envs(num_envs=3, render_mode="rgb_array", width=64, height=48)
    envs.reset(seed=1)
    before = envs.render()
    for _ in range(8):
        envs.step(np.array([[1.0], [-1.0], [0.0]], np.float32))
    after = envs.render()
    assert len(after) == 3
    for picture in after:
        assert (picture.shape, picture.dtype) == ((48, 64, 3), np.uint8)
        assert picture.std() > 5
    assert not np.array_equal(before[0], after[0])
    assert not np.array_equal(after[0], after[1])


def test_keys_and_overrides_reach_the_task(make_envs):
    envs = make_envs("Ant", num_threads=1, overrides=["task.env.episodeLength=200"])
    assert envs.unwrapped.task.max_episode_length == 200
    with pytest.raises(ConfigError, match="num_thread"):
        make_envs(num_thread=2)
