"""Chooses position drives for a robot's joints, one actuator for each degree of freedom."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from isaacgymenvs_lite.errors import ConfigError, suggest
from isaacgymenvs_lite.robots.limbs import ancestors
from isaacgymenvs_lite.robots.settings import DriveSettings

# kp in Nm/rad for each Nm of effort: a drive reaches its effort (largest torque) at an error of
# 0.25 rad.
_KP_OF_EFFORT = 4.0
# kd / kp in s, the lag of a drive. With a lag of 0.1 s a robot learns to walk far later. The lag is
# longer than a simulation step, so that light links do not oscillate.
_KD_OF_KP = 0.03
# Inertia of rotor and gears in kg m^2 for each Nm of effort, for files without this inertia. The
# motors of a G1 with 25, 50, 88 and 139 Nm have the values 1.4e-4, 1.4e-4, 1.2e-4 and 1.8e-4.
# Without this inertia a motor at its limit accelerates a light shank too much within a simulation
# step.
_ARMATURE_OF_EFFORT = 1.5e-4
# A larger effort does not increase the gains, because the efforts of simulated robots may be
# arbitrary. The limit is a share of the robot's weight times its height; the share of a G1's knees
# is 0.56.
_MOST_OF_WEIGHT = 0.6
# An unknown effort is replaced by this share of weight times height. The share of a G1's hips is
# 0.35, that of its ankles 0.2.
_EFFORT_OF_WEIGHT = 0.35
# Largest acceleration in rad/s^2. The limit keeps the drives of light fingers weaker than those of
# legs. It does not apply to the joints of standing legs, because the ankle of a light foot would
# get almost no effort.
_MAX_ACCELERATION = 5000.0
# Torque of the median drive for an action of 1, as a multiple of the drive's effort. The noise of
# AMP's policies (0.055) is then about a fifth of the effort; a noise of twice this torque made a
# quadruped fall.
_EFFORTS_OF_AN_ACTION = 4.0
# Lower limit of the torque for an action of 1, as a share of weight times height, because weak
# motors would explore too little.
_WEIGHT_OF_AN_ACTION = 0.6
_MAX_ACTION_RAD = 2.0

_BALL = mujoco.mjtJoint.mjJNT_BALL
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


@dataclass(frozen=True)
class Motor:
    """The motor of a joint in a file: kp, kd and effort in the joint's units; None means unknown.

    A joint that follows a leading joint (`mimic`) has no motor, because the drive of the follower
    would pull against the leading joint.
    """

    kp: float | None = None
    kd: float | None = None
    effort: float | None = None
    follows: bool = False


@dataclass(frozen=True)
class Drive:
    """Gains of a joint's drives: kp (Nm/rad), kd (Nm s/rad), effort (Nm), armature (kg m^2)."""

    joint: str
    kp: float
    kd: float
    effort: float
    armature: float


def choose_drives(
    model: mujoco.MjModel,
    motors: Mapping[str, Motor],
    weight_moment: float,
    patterns: Mapping[str, DriveSettings],
    where: str,
    contact_bodies: Sequence[str] = (),
) -> list[Drive]:
    """Choose the gains of all hinges and balls from the settings, else the file, else an estimate.

    The file's kp and kd come from its position actuator. The estimate of kp is computed from the
    effort of the joint or its motor, or from the robot's weight if the effort is unknown. The
    estimate of kd is computed from kp.

    Raises:
        ConfigError: a pattern matches no joint, or no pattern matches a joint.
    """
    # The bodies that touch the floor, the root, and all bodies between them and the root.
    carrying = {i for name in contact_bodies for i in ancestors(model, model.body(name).id)}
    joints = np.flatnonzero(model.jnt_type != mujoco.mjtJoint.mjJNT_FREE).tolist()
    names = [model.joint(joint).name for joint in joints]
    _check_patterns(names, patterns, where)
    chosen = []
    for joint, name in zip(joints, names, strict=True):
        given = next((d for p, d in patterns.items() if fnmatchcase(name, p)), DriveSettings())
        motor = motors.get(name, Motor())
        effort = given.effort or motor.effort
        if not effort:
            effort = _EFFORT_OF_WEIGHT * weight_moment
            if int(model.jnt_bodyid[joint]) not in carrying:
                dof = int(model.jnt_dofadr[joint])
                size = 3 if model.jnt_type[joint] == _BALL else 1
                inertia = float(model.dof_M0[dof : dof + size].max())
                effort = min(effort, _MAX_ACCELERATION * inertia)
        chosen.append(_drive(model, joint, motor, effort, weight_moment, given))
    return chosen


def _check_patterns(
    names: Sequence[str], patterns: Mapping[str, DriveSettings], where: str
) -> None:
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ConfigError(
                f"{where}: '{pattern}' matches no joint{suggest(pattern, names)};"
                f" joints: {', '.join(names)}"
            )
    without = [name for name in names if not any(fnmatchcase(name, p) for p in patterns)]
    if patterns and without:
        raise ConfigError(
            f"{where}: no pattern matches the joints {', '.join(without[:8])}; add them, or"
            " '*': {} at the end for this project's gains"
        )


def _drive(
    model: mujoco.MjModel,
    joint: int,
    motor: Motor,
    effort: float,
    weight_moment: float,
    given: DriveSettings,
) -> Drive:
    kp, kd = given.kp, given.kd
    if kp is None and motor.follows:
        kp = 0.0
    if kp is None:
        kp = motor.kp or _KP_OF_EFFORT * _useful(effort, weight_moment)
        kd = kd if kd is not None else motor.kd
    if kd is None:
        kd = _KD_OF_KP * kp
    armature = given.armature
    if armature is None:
        armature = float(model.dof_armature[model.jnt_dofadr[joint]])
    if given.armature is None and armature == 0 and kp > 0 and motor.kp is None:
        armature = _ARMATURE_OF_EFFORT * _useful(effort, weight_moment)
    return Drive(model.joint(joint).name, kp, kd, effort, armature)


def action_range(drives: Sequence[Drive], weight_moment: float) -> float:
    """Return the offset of the targets (rad) for an action of 1, at most 2 rad.

    At this offset the median drive would exert four times its effort, or 0.6 of weight times height
    if this torque is larger.
    """
    driven = [drive for drive in drives if drive.kp > 0]
    if not driven:
        return _MAX_ACTION_RAD
    of_effort = np.median([_useful(drive.effort, weight_moment) / drive.kp for drive in driven])
    of_weight = weight_moment / np.median([drive.kp for drive in driven])
    wanted = max(_EFFORTS_OF_AN_ACTION * of_effort, _WEIGHT_OF_AN_ACTION * of_weight)
    return min(float(wanted), _MAX_ACTION_RAD)


def _useful(effort: float, weight_moment: float) -> float:
    return min(effort, _MOST_OF_WEIGHT * weight_moment)


def motors_of_file(model: mujoco.MjModel) -> dict[str, Motor]:
    """Return a dictionary from joint names to motors, which actuators and joints describe."""
    of_joints = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    followers = set(model.eq_obj1id[of_joints & (model.eq_obj2id >= 0)].tolist())
    return {model.joint(i).name: _motor(model, i, i in followers) for i in range(model.njnt)}


def _motor(model: mujoco.MjModel, joint: int, follows: bool) -> Motor:
    kp = kd = effort = None
    for actuator in np.flatnonzero(model.actuator_trnid[:, 0] == joint):
        if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        gear = float(np.abs(model.actuator_gear[actuator, :3]).max())
        gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator]
        simple = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        if simple and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE:
            if bias[1] < 0:
                kp = -float(bias[1]) * gear**2
                kd = -float(bias[2]) * gear**2 if bias[2] < 0 else None
        elif simple and model.actuator_ctrllimited[actuator]:
            effort = float(np.abs(gain * model.actuator_ctrlrange[actuator]).max()) * gear
        if model.actuator_forcelimited[actuator]:
            effort = float(np.abs(model.actuator_forcerange[actuator]).max()) * gear
    if model.jnt_actfrclimited[joint]:
        effort = float(np.abs(model.jnt_actfrcrange[joint]).max())
    return Motor(kp or None, kd, effort or None, follows)


def add_drives(spec: mujoco.MjSpec, drives: Sequence[Drive]) -> None:
    """Add one position actuator for each degree of freedom, with the names of `ModelLayout`.

    The lengths of a ball joint's three actuators are the components of its rotation vector in the
    child frame; tasks read the limits of the axes from `lengthrange` (rad). The function also sets
    armatures and force limits of the joints.
    """
    for drive in drives:
        joint = spec.joint(drive.joint)
        joint.armature = drive.armature
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if joint.type != _BALL:
            add_actuator(spec, drive.joint, drive.kp, drive.kd, drive.effort)
            continue
        limit = float(joint.range[1])
        limit = math.radians(limit) if spec.compiler.degree else limit
        if joint.limited == mujoco.mjtLimited.mjLIMITED_FALSE or limit <= 0:
            limit = math.pi
        for axis, direction in _AXES.items():
            actuator = add_actuator(
                spec, drive.joint, drive.kp, drive.kd, drive.effort, f"_{axis}", direction
            )
            actuator.lengthrange[:] = (-min(limit, math.pi), min(limit, math.pi))


def add_actuator(
    spec: mujoco.MjSpec,
    joint: str,
    kp: float,
    kd: float,
    effort: float,
    suffix: str = "",
    direction: tuple[int, int, int] = (1, 0, 0),
) -> mujoco.MjsActuator:
    """Add a position actuator with the name of its joint and a suffix.

    `kp` is in Nm/rad, `kd` in Nm s/rad and `effort` in Nm (N/m, N s/m and newton for slides).
    """
    actuator = spec.add_actuator(name=joint + suffix, target=joint)
    actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
    actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    # The defaults of the file would otherwise also apply to the new actuators.
    actuator.dyntype, actuator.nsample = mujoco.mjtDyn.mjDYN_NONE, 0
    actuator.ctrllimited = actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator.gainprm[:] = 0
    actuator.biasprm[:] = 0
    actuator.gainprm[0] = kp
    actuator.biasprm[:3] = (0, -kp, -kd)
    actuator.gear[:] = (*direction, 0, 0, 0)
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    actuator.forcerange[:] = (-effort, effort)
    return actuator
