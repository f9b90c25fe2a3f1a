"""Limits of ball joints: their rotation vectors, how they change, and the solver's inequalities."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.motion.retargeting.solve import (
    DofLimits,
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
    # -190 deg about x is +170 deg as well, 125 deg beyond the upper limit of 45 deg.
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
