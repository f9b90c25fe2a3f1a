"""Limb lengths, soles and inverse kinematics of a robot that is the target of retargeting."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.motion.editing import interpolate_rotations
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import body_poses
from isaacgymenvs_lite.motion.retargeting.robot_mapping import RobotMapping, find_bend
from isaacgymenvs_lite.motion.retargeting.solve import (
    FIRST_BEND_RAD,
    LEAST_BEND_RAD,
    IkProblem,
    JointLimits,
    body_goals,
)
from isaacgymenvs_lite.motion.retargeting.source import (
    FEET,
    SIDES,
    Figure,
    Sole,
    find_sole,
    leg_length,
    rotated_in_body,
    round_bodies,
)
from isaacgymenvs_lite.motion.retargeting.targets import Targets
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.utils import rotations

_START_POSES = ("home", "stand", "standing")
_LEAD_IN = 30  # number of frames from the start pose to the first frame
_STANDS = 0.4  # least height of a standing robot's hips above the feet, divided by the legs' length
_LIMBS = (("thigh", "shin", "foot"), ("upper_arm", "lower_arm", "hand"))


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot as the target of retargeting; `robot_from_model` creates it."""

    model: mujoco.MjModel  # compiled model with a free root; other joints are hinges or ball joints
    mapping: RobotMapping  # from the humanoid's body names to the robot's bodies
    start: FloatArray  # (nq,), pose in which the robot stands upright
    figure: Figure  # lengths and soles of the robot, upright and facing +x
    # From the humanoid's body names to rotations (4,) xyzw of the bodies in the upright figure.
    frames: dict[str, FloatArray]
    hips: FloatArray  # (3,) m, vector from the pelvis' origin to the middle of the hips
    # From joint ids of the hinges that bend limbs to ranges (rad), which exclude straight limbs.
    bends: dict[int, tuple[float, float]]
    followers: Followers  # the joints that follow other joints

    def soles(self, qpos: FloatArray) -> FloatArray:
        """Return the world positions (T, 2, K, 3) m of both soles' points for qpos (T, nq)."""
        places = []
        for foot in FEET:
            body = self.mapping.bodies[foot].body
            origins, turns = body_poses(self.model, qpos, [body])
            upright = rotations.quat_conjugate(torch.from_numpy(self.frames[foot])).numpy()
            attitude = rotated_in_body(turns[:, 0], upright)
            places.append(self.figure.soles[foot].places(origins[:, 0], attitude))
        return self.padded(places)

    def padded(self, of_feet: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Stack values (T, K, ...) for the points of both soles into one array (T, 2, K, ...).

        If one foot has fewer points, its last point is repeated.
        """
        most = max(values.shape[1] for values in of_feet)
        rows = [[min(i, v.shape[1] - 1) for i in range(most)] for v in of_feet]
        return np.stack([v[:, row] for v, row in zip(of_feet, rows, strict=True)], axis=1)


def robot_from_model(
    model: mujoco.MjModel, mapping: RobotMapping, start: FloatArray | None = None
) -> Robot:
    """Prepare a robot as the target of retargeting.

    The robot stands upright in the pose `start` (nq,); None selects the mapping's start pose.
    Raises ConfigError if the robot does not stand in the start pose, if the model does not have a
    name, if a foot has no geoms, or if joints are neither the free root nor hinges nor ball joints.
    """
    _check(model, mapping)
    followers = Followers(model)
    if start is None:
        name, keys = mapping.start_pose, [model.key(i).name for i in range(model.nkey)]
        if name and name not in keys:
            raise ConfigError(f"start_pose: {unknown('key of the robot', name, keys)}")
        key = next((k for k in ((name,) if name else _START_POSES) if k in keys), None)
        start = np.array(model.qpos0 if key is None else model.key(key).qpos)
    start = followers.placed(start)
    found, turned = body_poses(model, start[None], [b.body for b in mapping.bodies.values()])
    places = dict(zip(mapping.bodies, found[0], strict=True))
    leg_m = leg_length({name: place[None] for name, place in places.items()})
    high_m = min(places[f"{side}_thigh"][2] - places[f"{side}_foot"][2] for side in SIDES)
    if high_m < max(_STANDS * leg_m, 1e-3):
        raise ConfigError(
            f"the robot does not stand in its start pose: a hip is {high_m:.2f} m above its "
            f"foot, and the legs are {leg_m:.2f} m long; give start_pose, a keyframe, or "
            "start_rotation, the root's quaternion xyzw, in a mapping file"
        )
    left = places["left_thigh"] - places["right_thigh"]
    half = 0.5 * math.atan2(-left[0], left[1])
    facing = torch.tensor((0.0, 0.0, math.sin(half), math.cos(half)), dtype=torch.float64)
    back = rotations.quat_conjugate(facing)

    def turned_back(vector: FloatArray) -> FloatArray:
        return rotations.quat_apply(back[None], torch.from_numpy(vector)[None])[0].numpy()

    upright = {body: turned_back(place) for body, place in places.items()}
    hips = 0.5 * (upright["right_thigh"] + upright["left_thigh"])
    pelvis = upright["pelvis"]
    upright["pelvis"] = hips
    attitudes = torch.from_numpy(turned[0])
    frames = rotations.quat_mul(back.expand_as(attitudes), attitudes).numpy()
    soles = {}
    for foot in FEET:
        points, radii = find_sole(model, start, mapping.bodies[foot].body)
        soles[foot] = Sole(np.stack([turned_back(point) for point in points]), radii)
    names = tuple(upright)
    parents = [mapping.parent(name) for name in names]
    figure = Figure(
        names,
        tuple(-1 if parent is None else names.index(parent) for parent in parents),
        np.stack([upright[n] - upright[p or n] for n, p in zip(names, parents, strict=True)]),
        soles,
        round_bodies(leg_length({name: place[None] for name, place in upright.items()}), names),
        pins_feet=True,
    )
    frames_by_name = dict(zip(mapping.bodies, frames, strict=True))
    bends = _bends(model, mapping, start)
    return Robot(model, mapping, start, figure, frames_by_name, hips - pelvis, bends, followers)


def robot_problem(robot: Robot, targets: Targets, fps: float) -> IkProblem:
    """Return the inverse kinematics problem whose goals are the targets."""
    names = robot.figure.body_names
    goals, weights = {}, {}
    for name, entry in robot.mapping.bodies.items():
        rotation = entry.rotation if name in targets.turns else 0.0
        if entry.position == rotation == 0.0:
            continue
        goal = body_goals(names, targets, name)
        turns = rotations.xyzw_from_wxyz(torch.from_numpy(goal[:, :4]))
        if name == "pelvis":
            hips = torch.from_numpy(robot.hips).expand(len(goal), 3)
            goal[:, 4:] -= rotations.quat_apply(turns, hips).numpy()
        own = torch.from_numpy(rotated_in_body(turns.numpy(), robot.frames[name]))
        goal[:, :4] = rotations.wxyz_from_xyzw(own).numpy()
        goals[entry.body], weights[entry.body] = goal, (entry.position, rotation)
    first_pose = _first_pose(robot, goals)
    places, turns = body_poses(robot.model, first_pose[None], list(goals))
    # `_LEAD_IN` additional goals lead from the first pose to the first target. A direct search may
    # rotate an arm the long way round and stop at its limits.
    share = np.arange(_LEAD_IN) / _LEAD_IN
    for (body, goal), place, turn in zip(goals.items(), places[0], turns[0], strict=True):
        first = rotations.xyzw_from_wxyz(torch.from_numpy(goal[:1, :4])).numpy()
        way = (turn[None].repeat(_LEAD_IN, 0), first.repeat(_LEAD_IN, 0))
        steps = torch.from_numpy(interpolate_rotations(*way, share))
        between = place + share[:, None] * (goal[0, 4:] - place)
        lead = np.concatenate((rotations.wxyz_from_xyzw(steps).numpy(), between), axis=1)
        goals[body] = np.concatenate((lead, goal))
    limits = _limits(robot)
    return IkProblem(robot.model, fps, goals, weights, first_pose, robot.start, limits, _LEAD_IN)


def _check(model: mujoco.MjModel, mapping: RobotMapping) -> None:
    """Raise a ConfigError for unsupported joint types and for unknown body names."""
    kinds = [mujoco.mjtJoint(kind) for kind in model.jnt_type]
    if not kinds or kinds[0] != mujoco.mjtJoint.mjJNT_FREE or model.jnt_bodyid[0] != 1:
        raise ConfigError(
            "the robot has no free joint at its first body and cannot move through the world; add "
            "<freejoint/> to its root"
        )
    for i, kind in enumerate(kinds[1:], start=1):
        if kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL):
            raise ConfigError(
                f"joint '{model.joint(i).name}' of the robot is a {kind.name[6:].lower()} joint, "
                "expected hinge or ball joints below the free root; fix or remove it"
            )
    known = [model.body(i).name for i in range(1, model.nbody)]
    used: dict[str, str] = {}
    if not mapping.bodies:
        raise ConfigError(
            f"mapping={mapping.name} has no bodies; guess_robot_mapping(model) finds them by name"
        )
    for name, entry in mapping.bodies.items():
        where = f"mapping={mapping.name}: bodies.{name}"
        if entry.body not in known:
            raise ConfigError(f"{where}: {unknown('body of the robot', entry.body, known)}")
        if entry.body in used:
            raise ConfigError(
                f"{where} and bodies.{used[entry.body]} are both '{entry.body}', expected different"
                " bodies"
            )
        used[entry.body] = name


def _bends(
    model: mujoco.MjModel, mapping: RobotMapping, start: FloatArray
) -> dict[int, tuple[float, float]]:
    """Return the hinges that bend limbs (`find_bend`) and the allowed range (rad) of each hinge.

    The angle at which the limb is straight divides a hinge's range; the larger part is allowed.
    """
    bends = {}
    for side in SIDES:
        for parts in _LIMBS:
            limb = [mapping.bodies.get(f"{side}_{part}") for part in parts]
            top, *_, end = limb
            if top is None or end is None or None in limb:
                continue
            bend = find_bend(model, start, model.body(top.body).id, model.body(end.body).id)
            if bend is None:
                continue
            joint, angles, distances = bend
            low, high = angles[0], angles[-1]
            straight = angles[distances.argmax()]
            if high - straight >= straight - low:
                bends[joint] = (straight + LEAST_BEND_RAD, high)
            else:
                bends[joint] = (low, straight - LEAST_BEND_RAD)
    return bends


def _limits(robot: Robot) -> JointLimits:
    model = robot.model
    hinges, balls = {}, {}
    for joint in range(1, model.njnt):
        if joint in robot.followers.joints:
            continue
        limited = bool(model.jnt_limited[joint])
        low, high = model.jnt_range[joint] if limited else (-math.inf, math.inf)
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            balls[joint] = (np.full(3, -math.tau), np.full(3, math.tau), float(high))
        else:
            hinges[joint] = robot.bends.get(joint, (low, high))
    return JointLimits(hinges, balls, robot.mapping.fastest_rad_s)


def _first_pose(robot: Robot, goals: dict[str, FloatArray]) -> FloatArray:
    """Return the start pose with bent limbs and with the pelvis at the pelvis' first goal."""
    qpos = robot.start.copy()
    for joint, (low, high) in robot.bends.items():
        near, far = (low, high) if abs(low) < abs(high) else (high, low)
        column = robot.model.jnt_qposadr[joint]
        if not low <= qpos[column] <= high or abs(qpos[column] - near) < FIRST_BEND_RAD:
            qpos[column] = near + math.copysign(min(FIRST_BEND_RAD, high - low), far - near)
    qpos = robot.followers.placed(qpos)
    pelvis = robot.mapping.bodies["pelvis"].body
    poses = body_poses(robot.model, qpos[None], [pelvis])
    place, turn = (torch.from_numpy(value[0]) for value in poses)
    goal = torch.from_numpy(goals[pelvis][:1])
    change = rotations.quat_mul(
        rotations.xyzw_from_wxyz(goal[:, :4]), rotations.quat_conjugate(turn)
    )
    root = torch.from_numpy(qpos[None, :7])
    root_turn = rotations.quat_mul(change, rotations.xyzw_from_wxyz(root[:, 3:]))
    qpos[:3] = (goal[:, 4:] + rotations.quat_apply(change, root[:, :3] - place))[0]
    qpos[3:7] = rotations.wxyz_from_xyzw(root_turn)[0]
    return qpos
