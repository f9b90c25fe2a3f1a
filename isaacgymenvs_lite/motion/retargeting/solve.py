"""Inverse kinematics of a whole motion with mink: poses that come nearest to the targets."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.limits import DofLimits
from isaacgymenvs_lite.motion.retargeting.targets import Targets
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations
from isaacgymenvs_lite.utils.optional_packages import import_package

_SOLVER = "daqp"  # the quadratic-programming solver that mink itself installs
_FIRST_ITERATIONS, _ITERATIONS = 200, 20
_CONVERGED_RAD = 1e-3  # largest step (rad, m) of the last iteration
_DAMPING = 1e-4
# Weights of places (1/m) and attitudes (1/rad). Where the feet stand comes first, then hands and
# trunk, then knees and elbows, which say to which side a limb bends. An ankle at its limit tilts
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
# The search begins with bent limbs, so that it feels to which side they bend.
_FIRST_BEND_RAD = 0.5


def solve_poses(model: mujoco.MjModel, skeleton: Skeleton, targets: Targets) -> FloatArray:
    """Return the poses (T, nq) within the limits of the joints that come nearest to the targets.

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
    turning = _turning(skeleton, targets)
    frames = {
        body: mink.FrameTask(body, "body", place, turn if body in turning else 0.0)
        for body in skeleton.body_names
        if (weights := _weights_of(body))
        for place, turn in (weights,)
    }
    wanted = {body: _poses(skeleton, targets, body) for body in frames}
    solved = np.zeros((len(targets.positions), model.nq))
    for frame in range(len(solved)):
        for body, task in frames.items():
            task.set_target(mink.SE3(wxyz_xyz=wanted[body][frame]))
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


def _turning(skeleton: Skeleton, targets: Targets) -> set[str]:
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
    for body in skeleton.hinge_body_ids:
        joint = model.body(skeleton.body_names[body]).jntadr[0]
        sign = 1.0 if model.jnt_range[joint, 1] > 0.0 else -1.0
        qpos[model.jnt_qposadr[joint]] = sign * _FIRST_BEND_RAD
    return qpos


def _poses(skeleton: Skeleton, targets: Targets, body: str) -> FloatArray:
    """Return quaternions wxyz and positions (T, 7) of a body, as mink takes them."""
    places = targets.positions[:, skeleton.body_names.index(body)]
    upright = np.tile((0.0, 0.0, 0.0, 1.0), (len(places), 1))
    turns = torch.from_numpy(targets.turns.get(body, upright))
    return np.concatenate((rotations.wxyz_from_xyzw(turns).numpy(), places), axis=1)
