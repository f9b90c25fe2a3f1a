from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.editing import cut, resample
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.qpos import (
    poses_from_qpos,
    qpos_from_poses,
)
from isaacgymenvs_lite.motion.skeleton import Skeleton


def test_mujoco_puts_the_bodies_where_the_clip_has_them(humanoid: Skeleton) -> None:
    clip = load_clips("run")[0][0]
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf/amp_humanoid.xml"))
    data = mujoco.MjData(model)
    qpos = qpos_from_poses(humanoid, clip.root_translation, clip.local_rotation)
    positions, _ = clip.global_poses()
    for frame in (0, 7, 33):
        data.qpos[:] = qpos[frame]
        mujoco.mj_kinematics(model, data)
        # float32 offsets in the clip: 1e-7 m per body of the chain.
        np.testing.assert_allclose(data.xpos[1:], positions[frame], atol=1e-6)


def test_round_trip(humanoid: Skeleton) -> None:
    clip = load_clips("walk")[0][0]
    qpos = qpos_from_poses(humanoid, clip.root_translation, clip.local_rotation)
    root, turns = poses_from_qpos(humanoid, qpos)
    np.testing.assert_allclose(root, clip.root_translation)
    np.testing.assert_allclose(turns, clip.local_rotation, atol=1e-6)


def test_names_and_limits_are_those_of_the_published_joints(humanoid: Skeleton) -> None:
    degrees = dict(zip(humanoid.dof_names, np.degrees(humanoid.dof_limits).tolist(), strict=True))
    assert degrees["abdomen_y"] == pytest.approx([-60.0, 90.0])
    assert degrees["left_shoulder_x"] == pytest.approx([-45.0, 180.0])
    assert degrees["right_elbow"] == pytest.approx([-160.0, 0.0])
    assert degrees["left_knee"] == pytest.approx([0.0, 160.0])


def test_a_cut_keeps_the_frames_of_its_ends(make_humanoid_clip) -> None:
    part = cut(make_humanoid_clip(num_frames=31), 0.2, 0.5)  # 30 fps, 1 s: frames 6 to 15
    assert part.num_frames == 10
    np.testing.assert_allclose(part.root_translation[[0, -1], 0], [0.2, 0.5])
    assert part.linear_velocity_w.shape == (10, 15, 3)


def test_times_outside_of_the_clip(make_humanoid_clip) -> None:
    with pytest.raises(MotionFileError, match=r"is no part of the clip; expected 0 <= start_s"):
        cut(make_humanoid_clip(num_frames=31), 0.0, 2.0)
    with pytest.raises(MotionFileError, match=r"leaves one frame of 0\.0333333 s"):
        cut(make_humanoid_clip(num_frames=31), 0.5, 0.505)


def test_half_the_rate_keeps_every_second_frame(make_humanoid_clip, humanoid, about) -> None:
    clip = make_humanoid_clip(num_frames=9)
    clip.local_rotation[:, 1] = about("z", np.linspace(0.0, 1.0, 9))
    half = resample(clip, 15.0)
    assert half.fps == 15.0
    np.testing.assert_allclose(half.local_rotation, clip.local_rotation[::2], atol=1e-12)
    np.testing.assert_allclose(half.root_translation, clip.root_translation[::2], atol=1e-12)


def test_a_higher_rate_turns_evenly(make_humanoid_clip, about) -> None:
    clip = make_humanoid_clip(num_frames=3)
    clip.local_rotation[:, 1] = about("z", [0.0, 4e-4, 8e-4])  # slerp of the library would step
    finer = resample(clip, 120.0)
    expected = about("z", np.linspace(0.0, 8e-4, 9))
    assert finer.num_frames == 9
    np.testing.assert_allclose(finer.local_rotation[:, 1], expected, atol=1e-12)
