"""Isaac Lab's names: its environments, and a script with the steps of its tutorial."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")

import isaacgymenvs_lite  # noqa: F401  registers the tasks
from isaacgymenvs_lite.config.compose import compose_task
from isaacgymenvs_lite.errors import ConfigError, WrapperError
from isaacgymenvs_lite.wrappers.sb3 import Sb3VecEnvWrapper, process_sb3_cfg


@pytest.mark.slow
def test_a_script_trains(gl, tmp_path):
    script = Path(__file__).with_name("isaac_lab_script.py")
    command = [sys.executable, str(script), "Cartpole", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "ep_rew_mean" in done.stdout or "total_timesteps" in done.stdout
    files = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert {"model.zip", "model_vecnormalize.pkl", "model_96_steps.zip"} <= files
    assert {"rl-video-step-10.mp4", "rl-video-step-20.mp4"} <= files


@pytest.mark.parametrize("name", ["Cartpole", "Cartpole-Direct", "Ant", "Humanoid"])
def test_environments_are_batches_of_tensors(name):
    cfg = compose_task(name.partition("-")[0], ["num_envs=3", "seed=1", "rl_device=cpu"])
    env = gymnasium.make(f"Isaac-{name}-v0", cfg=cfg)
    observations, _ = env.reset()
    size = env.unwrapped.single_observation_space["policy"].shape
    assert observations["policy"].shape == (3, *size)
    actions = 2 * torch.rand(env.action_space.shape) - 1
    observations, rewards, terminated, truncated, _ = env.step(actions)
    assert observations["policy"].shape == (3, *size) and rewards.shape == (3,)
    assert terminated.dtype == truncated.dtype == torch.bool
    env.close()


@pytest.mark.parametrize("make", ["make", "make_vec"])
def test_an_environment_of_gymnasium_steps_as_the_task_itself(make, make_cartpole):
    made = getattr(gymnasium, make)("Isaac-Cartpole-v0", num_envs=6)
    envs = [Sb3VecEnvWrapper(made), Sb3VecEnvWrapper(make_cartpole())]
    for env in envs:
        env.seed(5)
    np.testing.assert_array_equal(*(env.reset() for env in envs))
    for _ in range(60):
        steps = [env.step(np.ones((6, 1), np.float32)) for env in envs]
        for one, other in zip(*(step[:3] for step in steps), strict=True):
            np.testing.assert_array_equal(one, other)
    for env in envs:
        env.close()


def test_wrappers_that_change_a_step_are_refused():
    env = gymnasium.wrappers.TransformReward(gymnasium.make("Isaac-Cartpole-v0"), lambda r: 2 * r)
    with pytest.raises(WrapperError, match="TransformReward"):
        Sb3VecEnvWrapper(env)
    env.close()


def test_a_configuration_of_isaac_lab_is_refused():
    with pytest.raises(ConfigError, match=r'compose_task\("Cartpole", \["num_envs=64"\]\)'):
        gymnasium.make("Isaac-Cartpole-v0", cfg=object())


def test_an_agent_file_that_cannot_be_used():
    for keys, message in [
        ({"learning_rate": "lin_fast"}, "expected a number, or lin_ and a number"),
        ({"policy_kwargs": "dict(activation_fn=nn.system)"}, "expected the name of an activation"),
        ({"policy_kwargs": "open('harm', 'w')"}, "nothing of it is run"),
    ]:
        with pytest.raises(ConfigError, match=message):
            process_sb3_cfg(keys, 4)
