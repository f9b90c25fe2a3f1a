"""Inverse kinematics for all frames of a motion, with the library mink.

mink limits only the angles of hinges. In addition, `DofLimits` limits the three components of a
ball joint's rotation vector and the speed of hinges.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.targets import Targets
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.utils import rotations
from isaacgymenvs_lite.utils.optional_packages import import_package

_SOLVER = "daqp"  # quadratic programming solver, which mink installs
_FIRST_ITERATIONS, _ITERATIONS = 200, 20
_CONVERGED_RAD = 1e-3  # iterations end at a step below this (rad, m)
_DAMPING = 1e-4
# Maps the humanoid's body names without `left_` or `right_` to weights of positions (1/m) and
# rotations (1/rad). Feet have the largest weights, then hands and pelvis. The goals of shins and
# lower arms determine to which side a limb bends. Without the goal for the torso's position, a
# spine with several joints bends back when an arm is at a joint limit.
WEIGHTS = {
    "pelvis": (10.0, 3.0),
    "torso": (4.0, 3.0),
    "head": (0.0, 2.0),
    "lower_arm": (6.0, 0.0),
    "hand": (10.0, 0.5),
    "shin": (8.0, 0.0),
    "foot": (30.0, 3.0),
}
# Weights of the distance to the posture and of the distance to the last frame. The two weights
# determine what the goals do not determine, for example the twist of a straight arm.
_POSTURE, _STEADINESS = 0.02, 0.2
# Angle of knees and elbows at the start of the search, so that the gradient points to the side to
# which a limb bends.
FIRST_BEND_RAD = 0.5
# Least angle of knees and elbows. The search gets stuck at a straight limb, because a small bend
# does not change the length of the limb to first order.
LEAST_BEND_RAD = math.radians(2.0)


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits of the joints of a model."""

    hinges: Mapping[int, tuple[float, float]]  # from joint ids to lowest and highest angles (rad)
    # From joint ids to the lowest and the highest components (3,) rad of the rotation vector, and
    # the largest length of the vector in rad (MuJoCo's limit of a ball joint).
    balls: Mapping[int, tuple[FloatArray, FloatArray, float]]
    fastest_rad_s: float = math.inf  # largest speed of a hinge


@dataclass(frozen=True, eq=False)
class IkProblem:
    """A model whose first joint is a free root, and the goals of its bodies in T frames."""

    model: mujoco.MjModel  # the compiled model
    fps: float  # frames per second
    goals: Mapping[str, FloatArray]  # from bodies to (T, 7), quaternion wxyz and position in m
    weights: Mapping[str, tuple[float, float]]  # position (1/m) and rotation (1/rad)
    first_pose: FloatArray  # (nq,), start of the search in the first frame
    posture: FloatArray  # (nq,), preferred pose if the goals leave a choice
    limits: JointLimits  # limits of the joints
    lead_in: int = 0  # number of first frames that are solved but not returned


def solve_poses(problem: IkProblem) -> npt.NDArray[np.float64]:
    """Return the poses (T, nq) within the joint limits that are nearest to the goals.

    The search in a frame starts from the pose of the last frame. Joints that are coupled to another
    joint (`followers`) satisfy the coupling exactly.
    """
    mink = import_package("mink", "retargeting")
    model = problem.model
    configuration = mink.Configuration(model)
    configuration.update(problem.first_pose.copy())
    jointed = np.ones(model.nv)
    jointed[:6] = 0.0  # The posture cost must not include the root.
    posture = mink.PostureTask(model, cost=_POSTURE * jointed)
    posture.set_target(problem.posture)
    steadiness = mink.PostureTask(model, cost=_STEADINESS * jointed)
    limits = DofLimits(mink, model, problem.limits)
    followers = Followers(model)
    follow = []
    if followers.joints:
        coupled = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT).tolist()
        follow.append(mink.EqualityConstraintTask(model, cost=1.0, equalities=coupled))
    frames = {
        body: mink.FrameTask(body, "body", place, turn)
        for body, (place, turn) in problem.weights.items()
    }
    solved = np.zeros((len(next(iter(problem.goals.values()))), model.nq))
    for frame in range(len(solved)):
        for body, task in frames.items():
            task.set_target(mink.SE3(wxyz_xyz=problem.goals[body][frame]))
        tasks: list[Any] = [*frames.values(), posture]
        if frame:
            steadiness.set_target(solved[frame - 1])
            tasks.append(steadiness)
            limits.start_frame(solved[frame - 1], 1.0 / problem.fps)
        for _ in range(_ITERATIONS if frame else _FIRST_ITERATIONS):
            step = mink.solve_ik(
                configuration,
                tasks,
                1.0,
                solver=_SOLVER,
                damping=_DAMPING,
                limits=[limits],
                constraints=follow,
            )
            configuration.update(followers.placed(configuration.integrate(step, 1.0)))
            if np.abs(step).max() < _CONVERGED_RAD:
                break
        solved[frame] = configuration.q
    return solved[problem.lead_in :]


def weights_of(body: str) -> tuple[float, float] | None:
    """Return the weights of a body of the humanoid, or None if the body has no goal."""
    return WEIGHTS.get(body) or WEIGHTS.get(body.partition("_")[2])


def humanoid_problem(
    model: mujoco.MjModel, skeleton: Skeleton, targets: Targets, fps: float
) -> IkProblem:
    """Return the inverse kinematics problem of a shipped humanoid."""
    # A rigid hand has no goal for its rotation, because it cannot rotate relative to the forearm.
    jointed = {skeleton.body_names[body] for body in (0, *skeleton.dof_body_ids)}
    weights = {
        body: (pair[0], pair[1] if body in jointed & set(targets.turns) else 0.0)
        for body in skeleton.body_names
        if (pair := weights_of(body))
    }
    goals = {body: body_goals(skeleton.body_names, targets, body) for body in weights}
    limits = humanoid_limits(model, skeleton)
    # The first pose is the zero pose with bent knees and elbows, and with the pelvis at the pelvis'
    # first goal.
    first_pose = model.qpos0.copy()
    first_pose[:7] = np.roll(goals["pelvis"][0], 3)
    for joint in limits.hinges:
        sign = 1.0 if model.jnt_range[joint, 1] > 0.0 else -1.0
        first_pose[model.jnt_qposadr[joint]] = sign * FIRST_BEND_RAD
    return IkProblem(model, fps, goals, weights, first_pose, model.qpos0, limits)


def body_goals(names: Sequence[str], targets: Targets, body: str) -> FloatArray:
    """Return the goals (T, 7) of a body, quaternion wxyz and position."""
    places = targets.positions[:, names.index(body)]
    upright = np.tile((0.0, 0.0, 0.0, 1.0), (len(places), 1))
    turns = torch.from_numpy(targets.turns.get(body, upright))
    return np.concatenate((rotations.wxyz_from_xyzw(turns).numpy(), places), axis=1)


def humanoid_limits(model: mujoco.MjModel, skeleton: Skeleton) -> JointLimits:
    """Return the joint limits of a shipped humanoid, which exclude straight knees and elbows."""
    lower, upper = skeleton.dof_limits.T
    hinges, balls = {}, {}
    spans = itertools.pairwise(skeleton.dof_offsets)
    for body, (start, end) in zip(skeleton.dof_body_ids, spans, strict=True):
        joint = int(model.body(skeleton.body_names[body]).jntadr[0])
        if end - start == 3:
            balls[joint] = (lower[start:end], upper[start:end], math.inf)
        else:
            # The limb is straight at the limit that is 0.
            low, high = float(lower[start]), float(upper[start])
            hinges[joint] = (low or LEAST_BEND_RAD, high or -LEAST_BEND_RAD)
    return JointLimits(hinges, balls)


class DofLimits:
    """Linear limits on a step from the current pose, with the interface of mink's limits."""

    def __init__(self, mink: Any, model: mujoco.MjModel, limits: JointLimits) -> None:
        self._constraint = mink.Constraint
        self._model, self._limits = model, limits
        hinges = list(limits.hinges)
        self._columns = model.jnt_qposadr[hinges]
        self._lower, self._upper = np.array(list(limits.hinges.values())).reshape(-1, 2).T
        self._rows = np.eye(model.nv)[model.jnt_dofadr[hinges]]
        self._last: FloatArray | None = None
        self._reach = math.inf

    def start_frame(self, last: FloatArray, time_s: float) -> None:
        """Limit the speed of hinges in a frame `time_s` after the pose `last` (nq,)."""
        self._last, self._reach = last[self._columns], self._limits.fastest_rad_s * time_s

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
        """Return G and h of the limits G step <= h on a step (nv,) in the tangent space.

        `dt` is not used.
        """
        angles, lower, upper = configuration.q[self._columns], self._lower, self._upper
        if self._last is not None:
            lower = np.maximum(lower, self._last - self._reach)
            upper = np.minimum(upper, self._last + self._reach)
        nv = self._model.nv
        rows = [np.stack((self._rows, -self._rows), axis=1).reshape(-1, nv)]
        bounds = [np.stack((upper - angles, angles - lower), axis=1).ravel()]
        for joint, (low, high, longest) in self._limits.balls.items():
            column, dof = self._model.jnt_qposadr[joint], self._model.jnt_dofadr[joint]
            vector = nearest_vector(configuration.q[column : column + 4], low, high)
            row = np.zeros((3, nv))
            row[:, dof : dof + 3] = vector_jacobian(vector)
            rows += [row, -row]
            bounds += [high - vector, vector - low]
            length = float(np.linalg.norm(vector))
            if length > LEAST_BEND_RAD and math.isfinite(longest):
                rows.append(vector[None] / length @ row)
                bounds.append(np.array([longest - length]))
        return self._constraint(G=np.concatenate(rows), h=np.concatenate(bounds))


def nearest_vector(quaternion: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) rad of a quaternion wxyz with the least limit violation.

    A quaternion has several rotation vectors, because the angles a and a - 360 deg are the same
    rotation. An arm slightly beyond its limit of -180 deg must not be read as 180 deg.
    """
    short = np.zeros(3)
    mujoco.mju_quat2Vel(short, quaternion, 1.0)
    angle = float(np.linalg.norm(short))
    if angle < 0.5 * math.pi:
        return short
    long = short * (1.0 - 2.0 * math.pi / angle)
    return min((short, long), key=lambda v: max(0.0, float(np.maximum(v - upper, lower - v).max())))


def vector_jacobian(vector: FloatArray) -> npt.NDArray[np.float64]:
    """Return the derivative (3, 3) of a rotation vector with respect to a rotation of the child.

    The derivative is the inverse of the right Jacobian of SO(3).
    """
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        return np.eye(3) + 0.5 * cross
    factor = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / angle**2
    return np.eye(3) + 0.5 * cross + factor * cross @ cross
