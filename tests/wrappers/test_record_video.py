"""Gymnasium's recorder of videos, without MoviePy."""

from __future__ import annotations

import sys
from pathlib import Path

import av
import gymnasium
import numpy as np
import pytest

import isaacgymenvs_lite  # noqa: F401  registers the tasks
from isaacgymenvs_lite.wrappers import RecordVectorVideo, RecordVideo


@pytest.fixture(autouse=True)
def _no_moviepy(monkeypatch):
    monkeypatch.setitem(sys.modules, "moviepy", None)


def frames(file: Path) -> list[np.ndarray]:
    with av.open(str(file)) as container:
        return [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]


def test_an_episode_is_recorded(gl, tmp_path):
    env = gymnasium.make("IsaacGymEnvsLite/Cartpole-v0", render_mode="rgb_array")
    env = RecordVideo(env, str(tmp_path / "videos"), video_length=5)
    env.reset(seed=1)
    for _ in range(8):
        env.step(env.action_space.sample())
    env.close()
    (file,) = (tmp_path / "videos").iterdir()
    assert file.name == "rl-video-episode-0.mp4"
    pictures = frames(file)
    assert len(pictures) == 6 and pictures[0].shape == (240, 320)
    assert all(picture.std() > 5 for picture in pictures)


def test_all_environments_are_recorded_in_one_picture(gl, tmp_path):
    envs = gymnasium.make_vec("IsaacGymEnvsLite/Cartpole-v0", num_envs=4, render_mode="rgb_array")
    envs = RecordVectorVideo(
        envs, str(tmp_path / "videos"), step_trigger=lambda step: step == 1, video_length=3
    )
    envs.reset(seed=1)
    for _ in range(6):
        envs.step(envs.action_space.sample())
    envs.close()
    (file,) = (tmp_path / "videos").iterdir()
    assert file.name == "rl-video-step-1.mp4"
    assert frames(file)[0].size >= 4 * 240 * 320
