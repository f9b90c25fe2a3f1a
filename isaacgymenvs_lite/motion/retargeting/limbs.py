"""Legs and arms of a robot, found by its joints: for files whose names are of no help."""

from __future__ import annotations

import itertools
import math

import mujoco
import numpy as np
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.robots.limbs import ancestors, free_joints, limb_ends, touching_bodies
from isaacgymenvs_lite.utils import rotations

_ANGLES = 91  # at which a hinge is tried
# Arms end at least so far from the middle, as a share of the height of the hips.
_ASIDE = 0.1
_LEG, _ARM = ("thigh", "shin", "foot"), ("upper_arm", "lower_arm", "hand")


def body_poses(
    model: mujoco.MjModel, qpos: FloatArray, bodies: list[str]
) -> tuple[FloatArray, FloatArray]:
    """Return world positions (T, B, 3) m and rotations (T, B, 4) xyzw of bodies, qpos (T, nq)."""
    ids = [model.body(name).id for name in bodies]
    data = mujoco.MjData(model)
    places, turns = np.zeros((len(qpos), len(ids), 3)), np.zeros((len(qpos), len(ids), 4))
    for i, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        places[i], turns[i] = data.xpos[ids], data.xquat[ids]
    return places, rotations.xyzw_from_wxyz(torch.from_numpy(turns)).numpy()


def find_bend(
    model: mujoco.MjModel, start: FloatArray, top: int, end: int
) -> tuple[int, FloatArray, FloatArray] | None:
    """Return the hinge that bends a limb, a knee or an elbow.

    It is the hinge between both ends of the limb that changes their distance most.

    Args:
        model: of the robot.
        start: (nq,), the pose of the other joints.
        top: id of the limb's first body.
        end: id of its last one.

    Returns:
        The joint, angles (rad) over its range, and the distances (m) of both ends at them; None of
        a limb without a hinge between its ends.
    """
    between = itertools.takewhile(lambda body: body != top, ancestors(model, end)[1:])
    names = [model.body(top).name, model.body(end).name]
    followers, tried = Followers(model), []
    for joint in free_joints(model, list(between)):
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-math.pi, math.pi)
        angles = np.linspace(low, high, _ANGLES)
        poses = np.repeat(start[None], _ANGLES, axis=0)
        poses[:, model.jnt_qposadr[joint]] = angles
        places, _ = body_poses(model, followers.placed(poses), names)
        tried.append((joint, angles, np.linalg.norm(places[:, 0] - places[:, 1], axis=1)))
    return max(tried, key=lambda entry: float(np.ptp(entry[2])), default=None)


def find_limbs(model: mujoco.MjModel, start: FloatArray) -> dict[str, int]:
    """Return the ids of bodies of a robot on two legs by the humanoid's names, or {}.

    The legs are the limbs that end on the floor, the arms those that end farthest aside above them.
    A limb bends where `find_bend` says.

    Args:
        model: of a robot with a free root that looks along its x axis.
        start: (nq,), a pose in which it stands.
    """
    ends = [model.body(name).id for name in limb_ends(model, start)]
    grounded = {model.body_weldid[model.body(name).id] for name in touching_bodies(model, start)}
    feet = [end for end in ends if model.body_weldid[end] in grounded]
    legs = _pair(model, start, feet, _LEG, 0.0) if len(feet) == 2 else None
    if legs is None:
        return {}
    found = {"pelvis": legs[1], **legs[0]}
    others = [end for end in ends if end not in feet]
    arms = _pair(model, start, others, _ARM, _ASIDE * float(start[2])) if others else None
    if arms is not None:
        found |= arms[0]
        if arms[1] not in found.values():
            found["torso"] = arms[1]
    return found


def _pair(
    model: mujoco.MjModel,
    start: FloatArray,
    ends: list[int],
    parts: tuple[str, ...],
    aside_m: float,
) -> tuple[dict[str, int], int] | None:
    """Return the links of the limbs that end farthest to the left and right, and what carries both.

    Args:
        model: of the robot.
        start: (nq,), the pose in which it stands.
        ends: bodies to choose from, at least one.
        parts: names of a limb's three links.
        aside_m: how far from the middle they end at least.

    Returns:
        Bodies by names with sides, and the last body with joints that moves both limbs, or the
        root; None if there is no such pair.
    """
    places, turns = body_poses(model, start[None], [model.body(i).name for i in (1, *ends)])
    back = rotations.quat_conjugate(torch.from_numpy(turns[0, :1])).expand(len(ends), 4)
    from_root = torch.from_numpy(places[0, 1:] - places[0, :1])
    left_m = rotations.quat_apply(back, from_root).numpy()[:, 1]
    if left_m.max() <= aside_m or left_m.min() >= -aside_m:
        return None
    sides = {"left": ends[int(left_m.argmax())], "right": ends[int(left_m.argmin())]}
    # Bodies with joints, from below the root to the end.
    chains = {
        side: [i for i in reversed(ancestors(model, end)[:-1]) if model.body_jntnum[i] > 0]
        for side, end in sides.items()
    }
    shared = set(chains["left"]) & set(chains["right"])
    found: dict[str, int] = {}
    for side, end in sides.items():
        links = [body for body in chains[side] if body not in shared]
        bend = find_bend(model, start, links[0], end) if links else None
        lower = int(model.jnt_bodyid[bend[0]]) if bend is not None else None
        if lower not in links[1:]:
            return None
        last = links[-1] if links[-1] != lower else end
        if last == lower:
            return None
        upper = links[links.index(lower) - 1]
        names = (f"{side}_{part}" for part in parts)
        found |= dict(zip(names, (upper, lower, last), strict=True))
    return found, max(shared, default=1)
