"""Inverse kinematics of a whole motion with mink: the poses nearest to the targets.

mink itself limits hinges only; `DofLimits` also keeps the three components of a ball joint's
rotation vector within their limits.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.targets import Targets
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations
from isaacgymenvs_lite.utils.optional_packages import import_package

_SOLVER = "daqp"  # the quadratic-programming solver that mink itself installs
_FIRST_ITERATIONS, _ITERATIONS = 200, 20
_CONVERGED_RAD = 1e-3  # largest step (rad, m) of the last iteration
_DAMPING = 1e-4
# Weights of places (1/m) and attitudes (1/rad). The feet come first, then hands and trunk, then
# knees and elbows, which decide to which side a limb bends. An ankle at its limit tilts
# the foot rather than turn the leg out.
_WEIGHTS = {
    "pelvis": (10.0, 3.0),
    "torso": (0.0, 3.0),
    "head": (0.0, 2.0),
    "lower_arm": (6.0, 0.0),
    "hand": (10.0, 0.5),
    "shin": (8.0, 0.0),
    "foot": (30.0, 3.0),
}
# Towards the zero pose and towards the frame before. They decide what the targets leave open, such
# as the twist of a straight arm, and what a joint does that has reached its limit.
_POSTURE, _STEADINESS = 0.02, 0.2
# The search starts with bent limbs, so that the gradient has the side to which they bend.
_FIRST_BEND_RAD = 0.5
# Knees and elbows stay bent a little: bending a straight limb does not shorten it to first order,
# so that the search would get stuck there.
_LEAST_BEND_RAD = math.radians(2.0)


def solve_poses(model: mujoco.MjModel, skeleton: Skeleton, targets: Targets) -> FloatArray:
    """Return the poses (T, nq) nearest to the targets within the limits of the joints.

    Each search starts from the pose of the frame before.

    Raises:
        MissingPackageError: mink is not installed.
    """
    mink = import_package("mink", "retargeting")
    configuration = mink.Configuration(model)
    configuration.update(_first_pose(model, skeleton, targets))
    posture = mink.PostureTask(model, cost=_joint_costs(model, _POSTURE))
    posture.set_target(model.qpos0)
    steadiness = mink.PostureTask(model, cost=_joint_costs(model, _STEADINESS))
    limits = [DofLimits(mink, model, skeleton)]
    with_attitude = _with_attitude(skeleton, targets)
    frames = {
        body: mink.FrameTask(body, "body", place, turn if body in with_attitude else 0.0)
        for body in skeleton.body_names
        if (weights := _weights_of(body))
        for place, turn in (weights,)
    }
    goals = {body: _poses(skeleton, targets, body) for body in frames}
    solved = np.zeros((len(targets.positions), model.nq))
    for frame in range(len(solved)):
        for body, task in frames.items():
            task.set_target(mink.SE3(wxyz_xyz=goals[body][frame]))
        tasks: list[Any] = [*frames.values(), posture]
        if frame:
            steadiness.set_target(solved[frame - 1])
            tasks.append(steadiness)
        for _ in range(_ITERATIONS if frame else _FIRST_ITERATIONS):
            step = mink.solve_ik(
                configuration, tasks, 1.0, solver=_SOLVER, damping=_DAMPING, limits=limits
            )
            configuration.integrate_inplace(step, 1.0)
            if np.abs(step).max() < _CONVERGED_RAD:
                break
        solved[frame] = configuration.q
    return solved


def _weights_of(body: str) -> tuple[float, float] | None:
    return _WEIGHTS.get(body) or _WEIGHTS.get(body.partition("_")[2])


def _with_attitude(skeleton: Skeleton, targets: Targets) -> set[str]:
    """Return the bodies with an attitude of their own: rigid hands only follow their forearms."""
    jointed = {skeleton.body_names[body] for body in (0, *skeleton.dof_body_ids)}
    return jointed & set(targets.turns)


def _joint_costs(model: mujoco.MjModel, cost: float) -> FloatArray:
    costs = np.full(model.nv, cost)
    costs[:6] = 0.0  # the root goes where the targets are
    return costs


def _first_pose(model: mujoco.MjModel, skeleton: Skeleton, targets: Targets) -> FloatArray:
    """Return the zero pose with bent knees and elbows at the place of the first pelvis."""
    qpos = model.qpos0.copy()
    qpos[:7] = np.roll(_poses(skeleton, targets, "pelvis")[0], 3)
    spans = zip(skeleton.qpos_addresses, itertools.pairwise(skeleton.dof_offsets), strict=False)
    for place, (start, end) in spans:
        if end - start == 1:
            sign = 1.0 if skeleton.dof_limits[start, 1] > 0.0 else -1.0
            qpos[place] = sign * _FIRST_BEND_RAD
    return qpos


def _poses(skeleton: Skeleton, targets: Targets, body: str) -> FloatArray:
    """Return quaternions wxyz and positions (T, 7) of a body, as mink takes them."""
    places = targets.positions[:, skeleton.body_names.index(body)]
    upright = np.tile((0.0, 0.0, 0.0, 1.0), (len(places), 1))
    turns = torch.from_numpy(targets.turns.get(body, upright))
    return np.concatenate((rotations.wxyz_from_xyzw(turns).numpy(), places), axis=1)


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
        for group, (start, end) in enumerate(itertools.pairwise(skeleton.dof_offsets)):
            place = (skeleton.qpos_addresses[group], skeleton.qvel_addresses[group])
            limits = (lower[start:end], upper[start:end])
            if end - start == 3:
                self._balls.append((*place, *limits))
            else:
                self._hinges.append((*place, *_bent(*limits)))

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
        """Return G and h of G step <= h for a step (nv) in the tangent space; `dt` is not used."""
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
    """Return the rotation vector (3,) rad of a quaternion (4,) wxyz that exceeds the limits least.

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
    """Return the largest excess in rad of a rotation vector's components over their limits."""
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
    """Return the limits of a hinge, the straight limb excluded where it is one of them."""
    return (
        np.where(lower == 0.0, _LEAST_BEND_RAD, lower),
        np.where(upper == 0.0, -_LEAST_BEND_RAD, upper),
    )
