from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite import paths
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
