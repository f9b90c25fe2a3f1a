"""The statistics of VecNormalize in a file, written and read without a pickle."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.vec_env import VecNormalize

import isaacgymenvs_lite
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.workflows.sb3.agent import load_statistics, save_statistics
from isaacgymenvs_lite.wrappers import Sb3VecEnvWrapper


@pytest.fixture
def normalizer():
    task = isaacgymenvs_lite.make(task="Cartpole", num_envs=4)
    yield VecNormalize(Sb3VecEnvWrapper(task))
    task.close()


def test_statistics_come_back(normalizer, tmp_path):
    normalizer.reset()
    for _ in range(3):
        normalizer.step(np.ones((4, 1)))
    save_statistics(normalizer, tmp_path / "model.npz")
    other = VecNormalize(normalizer.venv)
    load_statistics(other, tmp_path / "model.npz")
    assert (other.obs_rms.mean == normalizer.obs_rms.mean).all()
    assert (other.obs_rms.var == normalizer.obs_rms.var).all()
    assert other.ret_rms.count == normalizer.ret_rms.count > 3


def test_statistics_of_another_task_are_an_error(normalizer, tmp_path):
    save_statistics(normalizer, tmp_path / "model.npz")
    with np.load(tmp_path / "model.npz") as saved:
        np.savez(tmp_path / "other.npz", **{**saved, "obs_mean": np.zeros(60)})
    with pytest.raises(CheckpointError, match="for this task and agent file"):
        load_statistics(normalizer, tmp_path / "other.npz")
