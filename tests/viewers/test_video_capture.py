from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.viewers.videos import VideoCapture, VideoWriter
from tests.viewers.conftest import assert_is_a_video, frames_of

# One task of each kind: a fixed base, rough ground, loose objects, a humanoid, a robot.
TASKS = ["Cartpole", "AnymalTerrain", "BallBalance", "HumanoidStrike", "RobotAMPVelocity"]


def play(env, capture: VideoCapture, num_steps: int) -> None:
    env.listeners.append(capture)
    generator = torch.Generator().manual_seed(1)
    env.reset()
    for _ in range(num_steps):
        if env.agents_call_reset_done:
            env.reset_done()
        env.step(2.0 * torch.rand(env.num_envs, env.num_actions, generator=generator) - 1.0)
    capture.close()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.usefixtures("gl", "small_pictures")
@pytest.mark.parametrize("task", TASKS)
def test_a_task_is_recorded(task, make_env, tmp_path):
    env = make_env(f"task={task}", "num_envs=2")
    capture = VideoCapture(env, VideoWriter(), tmp_path, every=100, length=12)
    play(env, capture, 12)
    (path,) = tmp_path.iterdir()
    frames, rate = frames_of(path)
    assert rate == pytest.approx(1.0 / env.simulation.dt, rel=1e-3)
    assert_is_a_video(frames, 12)


@pytest.mark.usefixtures("gl", "small_pictures")
def test_videos_start_at_regular_intervals(make_env, tmp_path):
    env = make_env("task=Cartpole", "num_envs=2")
    play(env, VideoCapture(env, VideoWriter(), tmp_path, every=5, length=3), 12)
    assert names(tmp_path) == [f"rl-video-step-{step}.mp4" for step in (0, 10, 5)]
    lengths = {path.stem[-2:]: len(frames_of(path)[0]) for path in tmp_path.iterdir()}
    assert lengths == {"-0": 3, "-5": 3, "10": 2}  # the last one was cut short by the end


@pytest.mark.usefixtures("gl", "small_pictures")
def test_several_environments_are_tiles_of_one_picture(make_env, tmp_path):
    env = make_env("task=Ant", "num_envs=4")
    play(env, VideoCapture(env, VideoWriter(), tmp_path, every=99, length=4, num_envs=3), 4)
    frames, _ = frames_of(next(tmp_path.iterdir()))
    assert frames.shape == (4, 120, 160, 3)
    tiles = [frames[3, y : y + 60, x : x + 80] for y in (0, 60) for x in (0, 80)]
    assert [bool(tile.mean() > 60) for tile in tiles] == [True, True, True, False]
    assert np.abs(tiles[0].astype(int) - tiles[1]).max() > 60  # another ant


@pytest.mark.usefixtures("gl", "small_pictures")
@pytest.mark.parametrize("follow", [True, False])
def test_the_camera_follows_unless_it_is_switched_off(follow, make_env, tmp_path, walk_clip):
    env = make_env(
        *("task=HumanoidAMP", "num_envs=1", f"task.env.motion_file={walk_clip}"),
        f"task.env.cameraFollow={follow}",
    )
    capture = VideoCapture(env, VideoWriter(), tmp_path, every=99, length=2)
    capture.after_step()
    roots = env.simulation.root_states.clone()
    roots[:, 0] += 5.0
    states = (roots, env.simulation.dof_pos.clone(), env.simulation.dof_vel.clone())
    env.simulation.write_state(torch.tensor([0]), *states)
    capture.after_step()
    capture.close()
    frames, _ = frames_of(next(tmp_path.iterdir()))
    middle = frames[1, 40:100, 65:95].astype(int)
    coloured = (middle.max(axis=2) - middle.min(axis=2) > 70).mean()
    assert (coloured > 0.1) == follow


@pytest.mark.usefixtures("gl", "small_pictures")
def test_a_video_that_cannot_be_written_ends_nothing(make_env, tmp_path, caplog):
    env = make_env("task=Cartpole", "num_envs=1")
    play(env, VideoCapture(env, VideoWriter(), tmp_path / "gone", every=9, length=2), 3)
    assert "cannot write the video" in caplog.text
