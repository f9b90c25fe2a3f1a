"""Limits of the humanoid's degrees of freedom, as the solver of mink takes them.

mink itself limits hinges only. Here the three components of a ball joint's rotation vector stay in
their box as well.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton

# Knees and elbows stay bent a little: a straight limb does not feel, to first order, that bending
# shortens it, and the search would stick there.
_LEAST_BEND_RAD = math.radians(2.0)


class DofLimits:
    """Linear limits of a step from the present pose; one of mink's limits by its method.

    Args:
        mink: the module.
        model: the compiled model of `skeleton`.
        skeleton: its joints and their limits.
    """

    def __init__(self, mink: Any, model: mujoco.MjModel, skeleton: Skeleton) -> None:
        self._constraint = mink.Constraint
        self._nv = model.nv
        lower, upper = skeleton.dof_limits.T
        self._balls, self._hinges = [], []
        for body, (start, end) in zip(
            skeleton.dof_body_ids, itertools.pairwise(skeleton.dof_offsets), strict=True
        ):
            joint = model.body(skeleton.body_names[body]).jntadr[0]
            place = (int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]))
            limits = (lower[start:end], upper[start:end])
            if end - start == 3:
                self._balls.append((*place, *limits))
            else:
                self._hinges.append((*place, *_bent(*limits)))

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
        """Return G and h of G step <= h for a step (nv) in the tangent space."""
        del dt  # Limits of places, not of speeds.
        rows, bounds = [], []
        for qpos, dof, lower, upper in self._hinges:
            row = np.zeros((1, self._nv))
            row[0, dof] = 1.0
            value = configuration.q[qpos : qpos + 1]
            rows += [row, -row]
            bounds += [upper - value, value - lower]
        for qpos, dof, lower, upper in self._balls:
            vector = nearest_vector(configuration.q[qpos : qpos + 4], lower, upper)
            row = np.zeros((3, self._nv))
            row[:, dof : dof + 3] = vector_jacobian(vector)
            rows += [row, -row]
            bounds += [upper - vector, vector - lower]
        return self._constraint(G=np.concatenate(rows), h=np.concatenate(bounds))


def nearest_vector(quaternion: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) rad of a quaternion (4,) wxyz that is least outside a box.

    A rotation by an angle a is one by a - 360 deg about the same axis as well; an arm that hangs
    down behind its limit of -180 deg must not appear at 180.
    """
    short = np.zeros(3)
    mujoco.mju_quat2Vel(short, quaternion, 1.0)
    angle = float(np.linalg.norm(short))
    if angle < 0.5 * math.pi:
        return short
    long = short * (1.0 - 2.0 * math.pi / angle)
    return min((short, long), key=lambda vector: beyond(vector, lower, upper))


def beyond(vector: FloatArray, lower: FloatArray, upper: FloatArray) -> float:
    """Return by how much in rad the components of a rotation vector leave their limits at most."""
    return max(0.0, float(np.maximum(vector - upper, lower - vector).max()))


def vector_jacobian(vector: FloatArray) -> npt.NDArray[np.float64]:
    """Return how a rotation vector (3,) changes with a small turn in the child's frame, (3, 3).

    The inverse of the right Jacobian of SO(3).
    """
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        return np.eye(3) + 0.5 * cross
    factor = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / angle**2
    return np.eye(3) + 0.5 * cross + factor * cross @ cross


def _bent(lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the limits of a hinge without the straight limb, where that is one of them."""
    return (
        np.where(lower == 0.0, _LEAST_BEND_RAD, lower),
        np.where(upper == 0.0, -_LEAST_BEND_RAD, upper),
    )
