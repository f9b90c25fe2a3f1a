"""The measuring functions, on clips whose figures can be told beforehand."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis import checks, dynamics, model_checks

SOLE_BELOW_ROOT_M = 0.421546 + 0.40987 + 0.05


def standing(humanoid: Skeleton, root: np.ndarray) -> MotionClip:
    """The zero pose, with the root at (T, 3)."""
    turns = np.zeros((len(root), humanoid.num_bodies, 4))
    turns[..., 3] = 1.0
    return MotionClip.from_poses(
        "standing",
        10.0,
        humanoid.body_names,
        humanoid.parent_indices,
        humanoid.local_translation,
        turns,
        root,
    )


def root_path(frames: int = 6) -> np.ndarray:
    return np.tile((0.0, 0.0, SOLE_BELOW_ROOT_M), (frames, 1))


def turned(clip: MotionClip, body: int, axis: int, angles_rad: np.ndarray) -> MotionClip:
    turns = clip.local_rotation.copy()
    turns[:, body] = 0.0
    turns[:, body, axis] = np.sin(0.5 * angles_rad)
    turns[:, body, 3] = np.cos(0.5 * angles_rad)
    return dataclasses.replace(clip, local_rotation=turns)


def test_soles_of_the_zero_pose(humanoid: Skeleton) -> None:
    corners = humanoid.sole_corners(*standing(humanoid, root_path()).global_poses())
    assert corners.shape == (6, 2, 4, 3)
    # Box centre (0.045, 0, -0.0225), half sizes (0.0885, 0.045, 0.0275), hip 0.084887 aside.
    np.testing.assert_allclose(corners[..., 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(sorted(set(corners[0, 0, :, 0].round(6))), [-0.0435, 0.1335])
    np.testing.assert_allclose(sorted(set(corners[0, 0, :, 1].round(6))), [-0.129887, -0.039887])
    np.testing.assert_allclose(sorted(set(corners[0, 1, :, 1].round(6))), [0.039887, 0.129887])


def test_standing_still(humanoid: Skeleton) -> None:
    feet = checks.foot_figures(standing(humanoid, root_path()), humanoid)
    assert feet.worst_slip_m == 0.0
    assert feet.deepest_m == pytest.approx(0.0, abs=1e-9)
    assert feet.double_support_share == 1.0
    assert feet.flight_share == 0.0
    assert np.isnan(feet.swing_clearance_m)


def test_sliding_sums_the_way_of_one_touch(humanoid: Skeleton) -> None:
    root = root_path(6)
    root[:, 0] = (0.0, 0.01, 0.03, 0.03, 0.04, 0.04)
    root[3, 2] += 0.02  # a hop: the touches before and after it count for themselves
    feet = checks.foot_figures(standing(humanoid, root), humanoid)
    assert feet.worst_slip_m == pytest.approx(0.03)
    assert feet.flight_share == pytest.approx(1 / 6)
    assert feet.highest_m == pytest.approx(0.02)


def test_sinking(humanoid: Skeleton) -> None:
    root = root_path()
    root[2, 2] -= 0.007
    assert checks.foot_figures(standing(humanoid, root), humanoid).deepest_m == pytest.approx(0.007)


def test_clearance_is_taken_in_the_middle_of_a_swing(humanoid: Skeleton) -> None:
    root = root_path(10)
    # 8 frames in the air: the middle half holds 0.03, 0.05, 0.06 and 0.04 m.
    root[1:9, 2] += (0.01, 0.02, 0.03, 0.05, 0.06, 0.04, 0.02, 0.01)
    feet = checks.foot_figures(standing(humanoid, root), humanoid)
    assert feet.swing_clearance_m == pytest.approx(0.03)


def test_limits(humanoid: Skeleton) -> None:
    clip = standing(humanoid, root_path(2))
    # The zero pose lies on the limits of knees and elbows.
    assert checks.limit_margin(clip, humanoid) == pytest.approx(0.0)
    shin = humanoid.body_names.index("right_shin")
    bent_back = turned(clip, shin, 1, np.array([0.0, -0.2]))
    assert checks.limit_margin(bent_back, humanoid) == pytest.approx(-0.2)


def test_number_of_limits_is_that_of_the_dofs(humanoid: Skeleton) -> None:
    assert len(checks.DOF_LIMITS_DEG) == humanoid.num_dofs


def test_peak_joint_speed(humanoid: Skeleton) -> None:
    thigh = humanoid.body_names.index("left_thigh")
    clip = turned(standing(humanoid, root_path(4)), thigh, 0, np.array([0.0, 0.1, 0.3, 0.3]))
    assert checks.peak_joint_speed(clip, humanoid) == pytest.approx(2.0)  # 0.2 rad in 0.1 s


def test_closure(humanoid: Skeleton) -> None:
    root = root_path(5)
    root[:, 0] = (0.0, 0.5, 1.0, 1.5, 2.0)
    clip = standing(humanoid, root)
    assert checks.closure_error(clip, 2) == pytest.approx((0.0, 0.0))
    bent = turned(clip, 1, 2, np.array([0.0, 0.2, 0.0, 0.2, 0.05]))
    turn_rad, place_m = checks.closure_error(bent, 2)
    assert turn_rad == pytest.approx(0.05)
    assert place_m == pytest.approx(0.0)


def test_symmetry(humanoid: Skeleton) -> None:
    """One frame on the right leg, one on the left: cycles of two frames."""
    clip = standing(humanoid, root_path(4))
    right, left = (humanoid.body_names.index(f"{side}_thigh") for side in ("right", "left"))
    step = np.array([0.3, 0.0, 0.3, 0.0])
    walk = turned(turned(clip, right, 0, step), left, 0, -(0.3 - step))
    assert checks.symmetry_error(walk, 2) == pytest.approx((0.0, 0.0), abs=1e-9)
    # Rotations about x change sign in the mirror: the same sign on both sides is not symmetric.
    limp = turned(turned(clip, right, 0, step), left, 0, 0.3 - step)
    assert checks.symmetry_error(limp, 2)[0] == pytest.approx(0.6)


def test_forces_of_a_throw(humanoid: Skeleton) -> None:
    """Standing needs one body weight, a free fall none."""
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf/amp_humanoid.xml"))
    root = root_path(5)
    np.testing.assert_allclose(
        model_checks.ground_force(standing(humanoid, root), humanoid, model)[:, 2], 1.0
    )
    times_s = np.arange(5) / 10.0
    root[:, 2] += 2.0 * times_s - 0.5 * 9.81 * times_s**2
    force = model_checks.ground_force(standing(humanoid, root), humanoid, model)
    np.testing.assert_allclose(force, 0.0, atol=1e-9)


def test_pressure_is_under_a_body_that_rests(humanoid: Skeleton) -> None:
    """And as far behind one that is pushed forward as its height times a / g."""
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf/amp_humanoid.xml"))
    root = root_path(9)
    clip = standing(humanoid, root)
    np.testing.assert_array_equal(model_checks.pressure_outside(clip, humanoid, model), 0.0)
    root[:, 0] = 0.5 * 3.0 * (np.arange(9) / 10.0) ** 2  # 3 m/s^2
    pushed = standing(humanoid, root)
    com = dynamics.centres_of_mass(model, model_checks.clip_qpos(clip, humanoid))[0]
    # The zero pose stands from 0.0435 m behind its ankles.
    expected = com[2] * 3.0 / 9.81 - com[0] - 0.0435
    assert expected > 0.1
    np.testing.assert_allclose(
        model_checks.pressure_outside(pushed, humanoid, model), expected, atol=1e-6
    )


def test_moment_of_a_body_that_begins_to_turn(humanoid: Skeleton) -> None:
    """About z it is the moment of inertia times the angular acceleration, 2 rad/s^2."""
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf/amp_humanoid.xml"))
    times_s = np.arange(9) / 10.0
    clip = turned(standing(humanoid, root_path(9)), 0, 2, 0.5 * 2.0 * times_s**2)
    found = dynamics.moments(model, model_checks.clip_qpos(clip, humanoid), 10.0)[2:-2]
    # The inertia of the zero pose about the root, less that of its mass at the centre of mass.
    data = mujoco.MjData(model)
    data.qpos[:] = model_checks.clip_qpos(standing(humanoid, root_path(2)), humanoid)[0]
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    armature = float(model.dof_armature[5])
    x, y, _ = data.subtree_com[1] - data.qpos[:3]
    about_com = inertia[5, 5] - armature - float(model.body_subtreemass[1]) * (x * x + y * y)
    np.testing.assert_allclose(found[:, 2], 2.0 * about_com, rtol=1e-3)


def test_self_contact(humanoid: Skeleton) -> None:
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf/amp_humanoid.xml"))
    clip = standing(humanoid, root_path(2))
    assert model_checks.deepest_self_contact(clip, humanoid, model) == 0.0
    # The thighs, capsules of radius 0.055 m whose axes are 0.17 m apart, cross when turned inwards.
    thigh = humanoid.body_names.index("right_thigh")
    crossed = turned(clip, thigh, 0, np.array([0.0, 0.25]))
    assert model_checks.deepest_self_contact(crossed, humanoid, model) > 0.01
