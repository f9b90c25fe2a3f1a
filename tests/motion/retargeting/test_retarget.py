"""Compares retargeted motion with the clips from which the source files were made."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.qpos import dofs_from_rotations
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping
from isaacgymenvs_lite.motion.retargeting.retarget import (
    KEY_BODIES,
    humanoid_report,
    load_bvh_source,
    retarget_bvh,
)
from isaacgymenvs_lite.motion.retargeting.solve import (
    DofLimits,
    humanoid_limits,
    nearest_vector,
    vector_jacobian,
)
from isaacgymenvs_lite.motion.retargeting.source import humanoid_figure
from isaacgymenvs_lite.motion.retargeting.targets import make_targets
from isaacgymenvs_lite.utils import rotations
from tests.packages import needs

# The search ends with a step of at most 1e-3 rad, which moves a hand by 1 mm at most. The pull
# towards the frame before is 1 % of the square of a hand's weight on 0.3 m; at 15 rad/s, 60 fps, it
# adds 2 mm.
_TOLERANCE_M = 3e-3


def distances(clip, original) -> dict[str, float]:
    """Return the largest distance in m of each body."""
    errors = np.linalg.norm(clip.global_poses()[0] - original.global_poses()[0], axis=-1).max(0)
    return dict(zip(clip.body_names, errors.tolist(), strict=True))


@pytest.mark.parametrize(("rig", "name"), [("cmu", "walk_slow"), ("lafan1", "jump")])
def test_the_clip_comes_back(tmp_path: Path, write_bvh, humanoid, rig, name) -> None:
    original = load_clips(name)[0][0]
    path = write_bvh(tmp_path / "a.bvh", original, rig, size=1.13)
    clip = retarget_bvh(path, load_mapping(rig), humanoid)
    assert clip.fps == original.fps
    assert max(distances(clip, original).values()) < _TOLERANCE_M


def test_long_arms_keep_their_directions(tmp_path: Path, write_bvh, humanoid) -> None:
    original = load_clips("walk_slow")[0][0]
    path = write_bvh(tmp_path / "a.bvh", original, "cmu", size=0.8, arms=1.25)
    clip = retarget_bvh(path, load_mapping("cmu"), humanoid)
    assert max(distances(clip, original).values()) < _TOLERANCE_M


def test_feet_that_swing_close_to_the_ground_do_not_slide(
    tmp_path: Path, write_bvh, humanoid
) -> None:
    path = write_bvh(tmp_path / "a.bvh", load_clips("run")[0][0], "cmu")
    targets = make_targets(load_bvh_source(path, load_mapping("cmu")), humanoid_figure(humanoid))
    clip = retarget_bvh(path, load_mapping("cmu"), humanoid)
    median, largest = humanoid_report(clip, targets, humanoid).slide_m_s or (np.inf, np.inf)
    assert median < 0.01
    assert largest < 0.5
    drift = np.arange(clip.num_frames)[:, None] / clip.fps * (0.0, 0.8, 0.0)
    sliding = dataclasses.replace(clip, root_translation=clip.root_translation + drift)
    median, _ = humanoid_report(sliding, targets, humanoid).slide_m_s or (0.0, 0.0)
    assert median == pytest.approx(0.8, abs=0.01)


def test_joint_limits_hold(tmp_path: Path, write_bvh, humanoid, make_humanoid_clip, about) -> None:
    original = make_humanoid_clip(num_frames=20)
    # 90 deg about z: the abdomen may turn by 50, the neck by 45.
    original.local_rotation[:, humanoid.body_names.index("torso")] = about(
        "z", np.linspace(0.0, 1.57, 20)
    )
    path = write_bvh(tmp_path / "a.bvh", original, "cmu")
    clip = retarget_bvh(path, load_mapping("cmu"), humanoid)
    dofs = dofs_from_rotations(humanoid, clip.local_rotation)
    lower, upper = humanoid.dof_limits.T
    # Limits are linear in each step; after the last one they hold to the square of 1e-3 rad.
    assert np.minimum(dofs - lower, upper - dofs).min() > -1e-4
    assert dofs[-1, humanoid.dof_names.index("abdomen_z")] == pytest.approx(upper[2], abs=1e-3)


@needs("pybullet_data")
@pytest.mark.parametrize("name", ["cartwheel", "getup_faceup"])
def test_published_motion_follows_within_its_joint_limits(
    tmp_path: Path, write_bvh, humanoid, name
) -> None:
    """Hands and feet follow motion capture that exceeds the humanoid's limits by up to 24 deg."""
    original = load_clips(f"deepmimic:{name}")[0][0]
    clip = retarget_bvh(
        write_bvh(tmp_path / "a.bvh", original, "cmu"), load_mapping("cmu"), humanoid
    )
    # The height of the ground may differ by a constant.
    clip.root_translation[:, 2] += np.float32(
        np.median(original.global_poses()[0][..., 2] - clip.global_poses()[0][..., 2])
    )
    errors = distances(clip, original)
    for body in ("right_hand", "left_hand", "right_foot", "left_foot"):
        assert errors[body] < 0.02, body
    # No pose jumps to another solution: joints have the same speeds as before.
    speed = np.abs(kinematics.joint_velocities(clip.local_rotation, clip.fps)).max()
    before = np.abs(kinematics.joint_velocities(original.local_rotation, original.fps)).max()
    assert speed < 1.5 * before


def test_the_armed_humanoid_turns_its_hand(
    tmp_path: Path, write_bvh, armed, make_humanoid_clip, about
) -> None:
    original = make_humanoid_clip(num_frames=10, skeleton=armed)
    original.local_rotation[:, armed.body_names.index("right_hand")] = about("x", [0.5] * 10)
    path = write_bvh(tmp_path / "a.bvh", original, "cmu")
    clip = retarget_bvh(path, load_mapping("cmu"), armed)
    hand = dofs_from_rotations(armed, clip.local_rotation)[:, armed.dof_names.index("right_hand_x")]
    np.testing.assert_allclose(hand, 0.5, atol=0.03)


def test_errors_are_told_in_metres(tmp_path: Path, write_bvh, humanoid, caplog) -> None:
    path = write_bvh(tmp_path / "a.bvh", load_clips("walk_slow")[0][0], "cmu")
    with caplog.at_level("INFO"):
        retarget_bvh(path, load_mapping("cmu"), humanoid, end_s=0.5)
    for body in KEY_BODIES:
        assert f"{body} 0.000" in caplog.text
    assert "scaled by 1.000" in caplog.text
    assert "m below the ground at most" in caplog.text


def quaternion(vector: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz of a rotation vector of any length."""
    turn = rotations.quat_from_angle_axis(
        torch.tensor(np.linalg.norm(vector)), torch.tensor(vector)
    )
    return rotations.wxyz_from_xyzw(turn).numpy()


def test_the_jacobian_is_the_derivative() -> None:
    for vector in ((0.0, 0.0, 0.0), (-2.5, -2.4, 0.3)):
        vector = np.array(vector)
        step = 1e-6
        measured = np.zeros((3, 3))
        for axis in range(3):
            moved = quaternion(vector)
            mujoco.mju_quatIntegrate(moved, np.eye(3)[axis], step)
            near = nearest_vector(moved, vector - 0.1, vector + 0.1)
            measured[:, axis] = (near - vector) / step
        # The differences are linear to about one step, and rounded to 1e-16 / 1e-6.
        np.testing.assert_allclose(vector_jacobian(vector), measured, atol=1e-4)


def test_an_arm_behind_its_limit_does_not_jump_to_the_other_side() -> None:
    # -190 deg about x equals +170 deg, which is 125 deg beyond the upper limit of 45 deg.
    vector = nearest_vector(
        quaternion(np.radians([-190.0, 0.0, 0.0])),
        np.radians([-180.0, -180.0, -90.0]),
        np.radians([45.0, 60.0, 90.0]),
    )
    np.testing.assert_allclose(np.degrees(vector), [-190.0, 0.0, 0.0], atol=1e-9)


def test_every_dof_has_its_two_rows(humanoid) -> None:
    mink = pytest.importorskip("mink")
    model = humanoid.model
    configuration = mink.Configuration(model)
    limits = DofLimits(mink, model, humanoid_limits(model, humanoid))
    constraint = limits.compute_qp_inequalities(configuration, 1.0)
    assert constraint.G.shape == (2 * 28, model.nv)
    assert not constraint.G[:, :6].any()  # the root is free
    # From the zero pose a step of 1 rad about one axis of a ball joint is 1 rad in its vector.
    allowed = np.sort(constraint.h)
    straight = np.radians(-2.0)  # knees and elbows keep bent
    np.testing.assert_allclose(allowed[:4], straight)
    assert np.isclose(np.degrees(allowed[4]), 15.0)  # the hip's narrowest limit
