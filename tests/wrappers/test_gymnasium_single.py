from __future__ import annotations

import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import isaacgymenvs_lite  # registers the tasks

assert isaacgymenvs_lite


@pytest.fixture
def make_single():
    made = []

    def make(task: str = "Cartpole", **keys) -> gymnasium.Env:
        made.append(gymnasium.make(f"IsaacGymEnvsLite/{task}-v0", **keys))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.mark.parametrize("task", ["Cartpole", "Quadcopter", "HumanoidAMP", "AnymalTerrain"])
def test_gymnasiums_checker_has_nothing_to_say(make_single, task: str, walk_clip: Path):
    overrides = {
        "HumanoidAMP": [f"task.env.motion_file={walk_clip}"],
        "AnymalTerrain": ["task.env.terrain.numLevels=2", "task.env.terrain.numTerrains=2"],
    }
    env = make_single(task, overrides=overrides.get(task, []))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    messages = {str(warning.message) for warning in said}
    # Observations have no limits, as IsaacGymEnvs' have none.
    assert not [line for line in messages if "infinity" not in line]


def test_an_episode_ends_with_its_last_observation(make_single):
    env = make_single()
    observation, info = env.reset(seed=1)
    assert info == {}
    for _ in range(200):
        observation, reward, terminated, truncated, _ = env.step(np.ones(1, np.float32))
        if terminated:
            break
    assert abs(observation[0]) > 3.0 or abs(observation[2]) > np.pi / 2
    assert reward == -2.0
    assert not truncated
    assert (np.abs(env.reset()[0]) <= 0.25).all()


def test_the_time_limit_truncates(make_single):
    env = make_single()
    env.reset(seed=1)
    env.unwrapped.task.progress_buf[:] = 498
    _, _, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
    assert truncated
    assert not terminated


def test_the_info_has_states_and_infos_of_the_task(make_single):
    env = make_single("Ant", overrides=["task.env.asymmetric_observations=True"])
    observation, info = env.reset(seed=1)
    assert np.array_equal(info["states"], observation)
    *_, info = env.step(np.zeros(8, np.float32))
    assert set(info) == {"states", "true_objective"}
    assert info["states"].shape == (60,)
