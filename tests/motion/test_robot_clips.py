"""Clips of robots with any joints: made from qpos, stored, edited, read by the motion library."""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.convert import joints_of_clip
from isaacgymenvs_lite.motion.editing import cut, resample
from isaacgymenvs_lite.motion.formats.joint_csv import save_robot_csv
from isaacgymenvs_lite.motion.formats.npz import load_npz, save_npz
from isaacgymenvs_lite.motion.formats.poselib import save_poselib_npy
from isaacgymenvs_lite.motion.loader import fit_to_skeleton, load_single_clip
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.motion.qpos import (
    clip_from_qpos,
    clip_to_qpos,
    dofs_from_rotations,
    poses_from_qpos,
    qpos_from_clip,
    rotations_from_dofs,
)
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.robots.load import load_robot
from isaacgymenvs_lite.utils import rotations
from tests.packages import file_of_package

FPS = 30.0
Moving = Callable[..., np.ndarray]
# One hinge per body, bodies turned at rest, no anchors: rotations determine the angles.
PLAIN = """
<mujoco><worldbody><body name="base"><freejoint/><geom size="0.1"/>
  <body name="left_leg" pos="0 0.2 0" euler="10 20 30"><geom size="0.1"/>
    <joint name="left_hip" axis="1 1 0" ref="20"/></body>
  <body name="right_leg" pos="0 -0.2 0" euler="-10 20 -30"><geom size="0.1"/>
    <joint name="right_hip" axis="1 -1 0" ref="20"/></body>
  <body name="head" pos="0 0 0.2"><geom size="0.1"/><joint name="neck" type="ball"/></body>
</body></worldbody></mujoco>
"""


@pytest.fixture
def plain() -> Skeleton:
    return Skeleton.from_model(mujoco.MjModel.from_xml_string(PLAIN))


@pytest.fixture
def clip(robot: Skeleton, moving: Moving) -> MotionClip:
    return clip_from_qpos("robot", FPS, robot, moving(robot))


@pytest.fixture
def lib(tmp_path: Path, robot: Skeleton, clip: MotionClip) -> MotionLib:
    hand = robot.body_names.index("left_hand")
    return MotionLib(
        save_npz(tmp_path / "robot.npz", clip), robot.num_dofs, [hand], "cpu", skeleton=robot
    )


def _hinges(skeleton: Skeleton) -> list[int]:
    spans = itertools.pairwise(skeleton.dof_offsets)
    return [start for start, end in spans if end - start == 1]


def _balls(skeleton: Skeleton) -> list[slice]:
    spans = itertools.pairwise(skeleton.dof_offsets)
    return [slice(start, end) for start, end in spans if end - start == 3]


def _angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest angle in rad between rotations (..., 4)."""
    apart = rotations.quat_mul(rotations.quat_conjugate(torch.from_numpy(a)), torch.from_numpy(b))
    return float(rotations.quat_log(apart).norm(dim=-1).max())


def _expect_mujocos_poses(skeleton: Skeleton, clip: MotionClip, qpos: np.ndarray) -> None:
    """Compare the clip's forward kinematics with mj_forward's."""
    model = skeleton.model
    data = mujoco.MjData(model)
    first = model.body(skeleton.body_names[0]).id
    bodies = slice(first, first + skeleton.num_bodies)
    positions, turns = clip.global_poses()
    for frame, pose in enumerate(qpos):
        data.qpos[: len(pose)] = pose
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(positions[frame], data.xpos[bodies], atol=1e-9)
        expected = rotations.xyzw_from_wxyz(torch.from_numpy(data.xquat[bodies])).numpy()
        assert _angle_between(turns[frame], expected) < 1e-7


def test_skeleton_of_a_robot(robot: Skeleton) -> None:
    assert robot.body_names == ("base", "left_arm", "left_hand", "spine", "skull", "jaw")
    assert robot.parent_indices == (-1, 0, 1, 0, 3, 4)
    assert robot.dof_body_ids == (1, 2, 2, 2, 3, 3, 3, 5)
    assert robot.dof_sizes == (1, 1, 1, 1, 1, 1, 3, 3)
    assert robot.shared_body_ids == (2, 3)
    assert robot.dof_names[:7] == (
        *("left_turn", "left_roll", "left_pitch", "left_yaw", "bend", "lean", "neck_x"),
    )
    np.testing.assert_allclose(robot.dof_limits[[0, 4]], [[-6.0, 6.0], [-1.0, 2.0]])
    assert np.isinf(robot.dof_limits[1]).all()
    np.testing.assert_allclose(robot.dof_limits[6], (-np.pi, np.pi))
    np.testing.assert_allclose(robot.joint_axes[0], np.array([1.0, 2.0, -0.5]) / np.sqrt(5.25))
    np.testing.assert_allclose(robot.joint_axes[6], 0.0)
    np.testing.assert_allclose(robot.joint_anchors[1], (0.05, 0.0, -0.1))
    np.testing.assert_allclose(robot.joint_refs, [0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(robot.rest_rotation[0], (0.0, 0.0, 0.0, 1.0))
    rest = np.array([0.1, -0.4, 0.3, 0.8]) / np.linalg.norm([0.1, -0.4, 0.3, 0.8])
    np.testing.assert_allclose(robot.rest_rotation[1], rest)
    # After the free joint's 7 numbers: six hinges, then two balls.
    assert robot.qpos_addresses == (7, 8, 9, 10, 11, 12, 13, 17, 21)
    assert not robot.has_simple_joints
    assert robot.has_offset_joints


def test_forward_kinematics_is_mujocos(
    robot: Skeleton, plain: Skeleton, moving: Moving, clip: MotionClip
) -> None:
    assert clip.local_translation.shape == (40, 6, 3)
    _expect_mujocos_poses(robot, clip, moving(robot))
    other = clip_from_qpos("plain", FPS, plain, moving(plain))
    assert other.local_translation.shape == (4, 3)
    _expect_mujocos_poses(plain, other, moving(plain))


@pytest.mark.parametrize(
    "name",
    [
        "mjcf/g1.xml",
        "dm_control/suite/humanoid_CMU.xml",
    ],
)
def test_forward_kinematics_of_robots(name: str, moving: Moving) -> None:
    path = paths.assets_dir() / name if name.startswith("mjcf/") else file_of_package(name)
    skeleton = Skeleton.from_model(load_robot(path).model)
    poses = moving(skeleton, 10)
    clip = clip_from_qpos(name, FPS, skeleton, poses)
    _expect_mujocos_poses(skeleton, clip, poses)
    model, back = clip_to_qpos(clip, skeleton)
    assert model is skeleton.model
    np.testing.assert_allclose(back[:, 7:][:, :8], poses[:, 7:][:, :8], atol=1e-12)


def test_qpos_comes_back(robot: Skeleton, clip: MotionClip, moving: Moving) -> None:
    poses = moving(robot)
    back = qpos_from_clip(robot, clip)
    assert np.abs(poses[:, 7:13]).max() > np.pi
    np.testing.assert_allclose(back[:, 7:13], poses[:, 7:13], atol=1e-12)
    for start in (3, 13, 17):  # a quaternion and its negative are one rotation
        assert _angle_between(back[:, start : start + 4], poses[:, start : start + 4]) < 1e-7
    # The box's columns may be given too.
    padded = np.concatenate((poses, np.tile(robot.model.qpos0[21:], (len(poses), 1))), axis=1)
    again = clip_from_qpos("padded", FPS, robot, padded)
    np.testing.assert_array_equal(again.local_rotation, clip.local_rotation)


def test_dofs_and_rotations_agree_with_mujoco(
    robot: Skeleton, plain: Skeleton, clip: MotionClip, moving: Moving
) -> None:
    assert clip.dof_pos is not None
    turns = rotations_from_dofs(robot, clip.local_rotation[:, 0], clip.dof_pos)
    assert _angle_between(turns, np.asarray(clip.local_rotation)) < 1e-7
    assert _angle_between(poses_from_qpos(robot, moving(robot))[1], turns) < 1e-7
    dofs = np.random.default_rng(1).uniform(-1.5, 1.5, (20, plain.num_dofs))
    root = np.tile([0.0, 0.0, 0.6, 0.8], (20, 1))
    back = dofs_from_rotations(plain, rotations_from_dofs(plain, root, dofs))
    np.testing.assert_allclose(back, dofs, atol=1e-12)


def test_library_at_and_between_frames(robot: Skeleton, clip: MotionClip, lib: MotionLib) -> None:
    assert clip.dof_pos is not None
    hinges = _hinges(robot)
    frames = np.arange(clip.num_frames - 1)
    for share in (0.0, 0.25, 0.9):
        state = lib.get_motion_state(np.zeros(len(frames), int), (frames + share) / FPS)
        mean = (1.0 - share) * clip.dof_pos[:-1] + share * clip.dof_pos[1:]
        # float32 of numbers up to 3.5, and of the share of a frame.
        np.testing.assert_allclose(state.dof_pos[:, hinges], mean[:, hinges], atol=2e-6)
        for ball in _balls(robot):
            apart = state.dof_pos[:, ball].numpy() - mean[:, ball]
            # The arc cosine of a float32 near 1 (3.5e-4); between frames also the chord of an arc,
            # and the slerp of nearly equal rotations, as in the original.
            np.testing.assert_allclose(apart, 0.0, atol=4e-4 if share == 0.0 else 2e-3)


def test_velocities_are_mujocos_finite_differences(
    robot: Skeleton, clip: MotionClip, lib: MotionLib, moving: Moving
) -> None:
    model = robot.model
    poses = np.tile(model.qpos0, (clip.num_frames, 1))
    poses[:, :21] = moving(robot)
    state = lib.get_motion_state([0] * clip.num_frames, np.arange(clip.num_frames) / FPS)
    rates = np.zeros(model.nv)
    for frame in range(clip.num_frames - 1):
        mujoco.mj_differentiatePos(model, rates, 1.0 / FPS, poses[frame], poses[frame + 1])
        np.testing.assert_allclose(state.dof_vel[frame], rates[6:18], atol=1e-5)
    torch.testing.assert_close(state.dof_vel[-1], state.dof_vel[-2])


def test_a_hinge_turns_on_beyond_pi(tmp_path: Path, humanoid: Skeleton, plain: Skeleton) -> None:
    for skeleton in (plain, humanoid):
        dof = _hinges(skeleton)[0]
        group = skeleton.dof_offsets.index(dof)
        poses = np.tile(skeleton.model.qpos0, (50, 1))
        angles = np.linspace(-3.5, 3.5, 50)
        poses[:, skeleton.qpos_addresses[group]] = angles
        file = save_npz(tmp_path / "turn.npz", clip_from_qpos("turn", FPS, skeleton, poses))
        lib = MotionLib(file, skeleton.num_dofs, [0], "cpu", skeleton=skeleton)
        times_s = np.linspace(0.0, 49.0 / FPS, 333)
        state = lib.get_motion_state([0] * 333, times_s)
        np.testing.assert_allclose(state.dof_pos[:, dof], np.linspace(-3.5, 3.5, 333), atol=2e-6)
        np.testing.assert_allclose(state.dof_vel[:, dof], 7.0 / (49.0 / FPS), rtol=1e-5)


def test_library_of_poses_without_joint_coordinates(
    tmp_path: Path, plain: Skeleton, moving: Moving
) -> None:
    clip = clip_from_qpos("plain", FPS, plain, moving(plain))
    assert clip.dof_pos is not None
    file = save_npz(tmp_path / "poses.npz", dataclasses.replace(clip, dof_pos=None))
    lib = MotionLib(file, plain.num_dofs, [0], "cpu", skeleton=plain)
    state = lib.get_motion_state([0] * clip.num_frames, np.arange(clip.num_frames) / FPS)
    for dof in _hinges(plain):
        # Without jumps, and whole turns away from the coordinates.
        turns = (state.dof_pos[:, dof].numpy() - clip.dof_pos[:, dof]) / (2.0 * np.pi)
        np.testing.assert_allclose(turns, round(turns[0]), atol=1e-5)


def test_files_keep_joint_coordinates(tmp_path: Path, robot: Skeleton, clip: MotionClip) -> None:
    read = load_npz(save_npz(tmp_path / "robot.npz", clip))
    for field in dataclasses.fields(clip)[1:]:
        np.testing.assert_array_equal(getattr(read, field.name), getattr(clip, field.name))
    path = save_robot_csv(tmp_path / "robot.csv", joints_of_clip(clip, robot))
    table, _ = load_single_clip(path, [robot])
    assert table.dof_pos is not None
    assert clip.dof_pos is not None
    np.testing.assert_allclose(table.dof_pos, clip.dof_pos, atol=1e-9)
    np.testing.assert_allclose(table.global_poses()[0], clip.global_poses()[0], atol=1e-9)
    with pytest.raises(MotionFileError, match=r"needs joints at the origins .* write a .npz file"):
        save_poselib_npy(tmp_path / "robot.npy", clip)


def test_cutting_and_resampling(robot: Skeleton, clip: MotionClip) -> None:
    assert clip.dof_pos is not None
    part = cut(clip, 0.2, 0.8)
    part.validate()
    np.testing.assert_array_equal(part.dof_pos, clip.dof_pos[6:25])
    np.testing.assert_array_equal(part.local_translation, clip.local_translation[6:25])
    double = resample(clip, 60.0, robot)
    double.validate()
    assert double.dof_pos is not None
    np.testing.assert_allclose(double.dof_pos[::2], clip.dof_pos, atol=1e-12)
    hinges = _hinges(robot)
    mean = 0.5 * (clip.dof_pos[1:] + clip.dof_pos[:-1])
    np.testing.assert_allclose(double.dof_pos[1::2, hinges], mean[:, hinges], atol=1e-12)
    _expect_mujocos_poses(robot, double, qpos_from_clip(robot, double))
    with pytest.raises(MotionFileError, match="pass the skeleton of the clip"):
        resample(clip, 60.0)


def test_a_ball_joint_is_resampled_across_half_a_turn(plain: Skeleton) -> None:
    poses = np.tile(plain.model.qpos0, (2, 1))
    half = 0.5 * np.array([np.pi - 0.2, np.pi + 0.4])
    poses[:, 9], poses[:, 12] = np.cos(half), np.sin(half)
    clip = clip_from_qpos("spin", FPS, plain, poses)
    assert clip.dof_pos is not None
    np.testing.assert_allclose(clip.dof_pos[:, 4], [np.pi - 0.2, -np.pi + 0.4])
    between = resample(clip, 2.0 * FPS, plain)
    assert between.dof_pos is not None
    np.testing.assert_allclose(np.abs(between.dof_pos[1, 4]), np.pi - 0.1, atol=1e-9)


def test_copies_are_dropped_with_their_coordinates(clip: MotionClip) -> None:
    doubled = {key: np.repeat(values, 2, axis=0) for key, values in clip.timed_arrays().items()}
    single = dataclasses.replace(clip, fps=2.0 * FPS, **doubled).drop_repeated_frames()
    single.validate()
    np.testing.assert_array_equal(single.dof_pos, clip.dof_pos)


def test_clips_that_do_not_fit_the_robot(
    robot: Skeleton, plain: Skeleton, clip: MotionClip, moving: Moving, caplog
) -> None:
    assert clip.dof_pos is not None
    assert fit_to_skeleton(clip, robot) is clip
    assert not caplog.records
    with pytest.raises(MotionFileError, match=r"robot: .* several joints on one body \(left_hand"):
        fit_to_skeleton(dataclasses.replace(clip, dof_pos=None), robot)
    with pytest.raises(MotionFileError, match=r"dof_pos has 11 columns, expected the 12 degrees"):
        fit_to_skeleton(dataclasses.replace(clip, dof_pos=clip.dof_pos[:, :11]), robot)
    legs = clip_from_qpos("legs", FPS, plain, moving(plain))
    order = [0, 2, 1, 3]
    swapped = dataclasses.replace(
        legs,
        body_names=tuple(legs.body_names[body] for body in order),
        local_rotation=legs.local_rotation[:, order],
    )
    with pytest.raises(MotionFileError, match="the order of its bodies differs from the model's"):
        fit_to_skeleton(swapped, plain)
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(dataclasses.replace(clip, dof_pos=clip.dof_pos + 0.2), robot)
    assert "joint coordinates (dof_pos) and poses differ by" in caplog.records[0].getMessage()


def test_rotations_off_a_hinges_axis_are_reported(plain: Skeleton, about, caplog) -> None:
    turns = np.tile(plain.rest_rotation, (2, 1, 1))
    off = rotations.quat_mul(torch.from_numpy(turns[:, 1]), torch.from_numpy(about("z", [0.2] * 2)))
    turns[:, 1] = off.numpy()
    args = (plain.body_names, plain.parent_indices, plain.local_translation, turns)
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(MotionClip.from_poses("off", FPS, *args, np.zeros((2, 3))), plain)
    (record,) = caplog.records
    assert "'left_leg' is a hinge about (0.707, 0.707, 0) but rotates 0.200 rad" in record.message


def test_qpos_of_another_shape_is_refused(robot: Skeleton) -> None:
    with pytest.raises(MotionFileError, match=r"shape \(4, 20\), expected finite numbers .* 21\)"):
        clip_from_qpos("short", FPS, robot, np.zeros((4, 20)))
