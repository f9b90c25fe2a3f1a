"""Limits of ball joints: their rotation vectors, how they change, and the solver's inequalities."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.retargeting.report import most_limited
from isaacgymenvs_lite.motion.retargeting.solve import (
    DofLimits,
    beyond,
    humanoid_limits,
    nearest_vector,
    vector_jacobian,
)
from isaacgymenvs_lite.utils import rotations


def quaternion(vector: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz of a rotation vector of any length."""
    turn = rotations.quat_from_angle_axis(
        torch.tensor(np.linalg.norm(vector)), torch.tensor(vector)
    )
    return rotations.wxyz_from_xyzw(turn).numpy()


@pytest.mark.parametrize(
    "vector", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.5), (2.0, 1.0, -1.5), (-2.5, -2.4, 0.3)]
)
def test_the_jacobian_is_the_derivative(vector) -> None:
    vector = np.array(vector)
    step = 1e-6
    measured = np.zeros((3, 3))
    for axis in range(3):
        moved = quaternion(vector)
        mujoco.mju_quatIntegrate(moved, np.eye(3)[axis], step)
        wide = np.full(3, 10.0)
        candidates = [nearest_vector(moved, vector - 0.1, vector + 0.1)]
        assert beyond(candidates[0], -wide, wide) == 0.0
        measured[:, axis] = (candidates[0] - vector) / step
    # The differences are linear to about one step, and rounded to 1e-16 / 1e-6.
    np.testing.assert_allclose(vector_jacobian(vector), measured, atol=1e-4)


def test_an_arm_behind_its_limit_does_not_jump_to_the_other_side() -> None:
    # -190 deg about x is +170 deg as well, 125 deg beyond the upper limit of 45 deg.
    vector = nearest_vector(
        quaternion(np.radians([-190.0, 0.0, 0.0])),
        np.radians([-180.0, -180.0, -90.0]),
        np.radians([45.0, 60.0, 90.0]),
    )
    np.testing.assert_allclose(np.degrees(vector), [-190.0, 0.0, 0.0], atol=1e-9)


def test_beyond() -> None:
    lower, upper = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0])
    assert beyond(np.array([0.5, -0.5, 1.0]), lower, upper) == 0.0
    assert beyond(np.array([0.5, -1.25, 1.1]), lower, upper) == 0.25


@pytest.mark.parametrize("num_dofs", [28, 31])
def test_every_dof_has_its_two_rows(num_dofs: int, humanoid, armed) -> None:
    mink = pytest.importorskip("mink")
    skeleton = {28: humanoid, 31: armed}[num_dofs]
    name = {28: "amp_humanoid", 31: "amp_humanoid_sword_shield"}[num_dofs]
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf" / f"{name}.xml"))
    configuration = mink.Configuration(model)
    limits = DofLimits(mink, model, humanoid_limits(model, skeleton))
    constraint = limits.compute_qp_inequalities(configuration, 1.0)
    assert constraint.G.shape == (2 * num_dofs, model.nv)
    assert not constraint.G[:, :6].any()  # the root is free
    # From the zero pose a step of 1 rad about one axis of a ball joint is 1 rad in its vector.
    allowed = np.sort(constraint.h)
    straight = np.radians(-2.0)  # knees and elbows keep bent
    np.testing.assert_allclose(allowed[:4], straight)
    assert np.isclose(np.degrees(allowed[4]), 15.0)  # the hip's narrowest limit


def test_the_joint_that_is_most_often_at_its_limit_is_named() -> None:
    at_limit = np.array([[True, False], [True, True], [False, True], [False, True]])
    assert most_limited(at_limit, ["knee", "ankle"]) == (0.75, "ankle")
    assert most_limited(at_limit & False, ["knee", "ankle"]) is None
