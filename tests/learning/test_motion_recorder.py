from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.evaluation.motion_recorder import MotionRecorder
from isaacgymenvs_lite.motion.formats.npz import load_npz
from isaacgymenvs_lite.motion.loader import load_single_clip
from isaacgymenvs_lite.motion.robot_file import load_clip_robot

PLAYER = "+train.params.config.player"


def test_the_first_episode_of_the_first_environment_becomes_a_clip(make_runner, tmp_path):
    path = tmp_path / "played.npz"
    runner = make_runner(
        f"{PLAYER}.record={path}",
        f"{PLAYER}.games_num=4",
        "task.env.episodeLength=8",
        "task.env.enableEarlyTermination=False",
        num_envs=2,
    )
    player = runner.create_player()
    positions, rotations = [], []
    step = player.env.step

    def taped(actions: torch.Tensor) -> Any:
        result = step(actions)
        positions.append(player.env.simulation.root_states[0, :3].tolist())
        rotations.append(player.env.simulation.body_rot[0, 0].tolist())
        return result

    player.env.step = taped
    player.run()
    clip = load_npz(path)
    # 7 control steps of 2/60 s; the second episode is not in it
    assert len(positions) == 14
    assert clip.num_frames == 7
    assert clip.fps == pytest.approx(1 / (2 * 0.0166))
    np.testing.assert_allclose(clip.root_translation, positions[:7], atol=1e-6)
    # a quaternion and its negative are the same rotation
    same = np.abs((clip.local_rotation[:, 0] * np.array(rotations[:7])).sum(-1))
    np.testing.assert_allclose(same, 1.0, atol=1e-6)


def test_a_recorded_clip_of_a_robot_is_what_was_simulated(make_runner, tmp_path):
    path = tmp_path / "played.npz"
    runner = make_runner(
        "task=RobotAMP",
        "task.env.motion_file=g1_walk",
        f"{PLAYER}.record={path}",
        f"{PLAYER}.games_num=2",
        "task.env.episodeLength=8",
        "task.env.enableEarlyTermination=False",
        num_envs=2,
    )
    player = runner.create_player()
    simulation, states = player.env.simulation, []
    step = player.env.step

    def taped(actions: torch.Tensor) -> Any:
        result = step(actions)
        parts = (simulation.root_states[0, :7], simulation.dof_pos[0], simulation.body_pos[0])
        states.append([part.clone() for part in parts])
        return result

    player.env.step = taped
    player.run()
    roots, dofs, bodies = (torch.stack(part).numpy() for part in zip(*states[:7], strict=True))
    clip, _ = load_single_clip(path, [load_clip_robot("mjcf/g1.xml").skeleton])
    assert clip.num_frames == 7 and clip.fps == pytest.approx(1 / (2 * 0.0166))
    assert clip.dof_pos is not None
    np.testing.assert_allclose(clip.dof_pos, dofs, atol=1e-6)
    np.testing.assert_allclose(clip.root_translation, roots[:, :3], atol=1e-6)
    # positions by MuJoCo's kinematics, of float32 coordinates
    np.testing.assert_allclose(clip.global_poses()[0], bodies[:, -clip.num_bodies :], atol=1e-4)
    assert np.abs(np.diff(clip.dof_pos, axis=0)).max() > 0.01


@pytest.mark.parametrize("name", ["nowhere/played.npz", "played.npy"])
def test_a_file_that_cannot_be_written_is_refused_before_the_play(name, make_runner, tmp_path):
    runner = make_runner(f"{PLAYER}.record={tmp_path / name}")
    with pytest.raises(ConfigError, match=r"player\.record=.*expected a \.npz file"):
        runner.create_player()


def test_a_task_without_references_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="reference motions"):
        MotionRecorder(object(), str(tmp_path / "played.npz"))
