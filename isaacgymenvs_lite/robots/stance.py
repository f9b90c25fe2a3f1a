"""Bends the legs of a robot that has four or more legs and no keyframe in its file.

The targets of the drives are offsets from the start pose. Straight legs would make a poor start
pose, because straight legs can only push the trunk upwards.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.robots.limbs import ancestors, free_joints, limb_ends, touching_bodies
from isaacgymenvs_lite.robots.start_pose import mesh_vertices, posed

_LEAST_LEGS = 4
# Distances from hip to foot as shares of the straight leg's length. The first distance that the
# joints can reach is used.
_LENGTHS = (0.75, 0.8, 0.85, 0.9, 0.65, 0.55)
_SHORTEST = 0.1  # share of the leg's length; a shorter link is not a thigh or shank
_PARALLEL = 0.95  # cosine of the angle between the axes of a hip and its knee
LATERAL = 0.7
"""A hinge swings a leg forwards and backwards if its axis has at least this y component."""
_SPRAWLED_RAD = 0.7  # legs at a larger angle to the vertical, like a spider's legs, are not bent

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Leg:
    """A leg of two hinges with parallel horizontal axes, and its foot.

    Vectors are complex numbers in the plane in which the hip swings the leg, so that a turn about
    the hip's axis adds to the angle. `hip` and `knee` are ids of hinges, `end` is the id of the
    last body; `thigh` and `shank` are in m, `down` is a unit vector. `knee_sign` is -1 if the axes
    of hip and knee have opposite directions. `ahead` has the x components of the plane's two
    directions.
    """

    hip: int
    knee: int
    end: int
    thigh: complex
    shank: complex
    down: complex
    knee_sign: float
    ahead: tuple[float, float]


def bend_legs(model: mujoco.MjModel, qpos: Vector) -> Vector | None:
    """Return the pose with each foot below its hip at 0.75 of the leg's length, or None.

    A knee that can bend forwards and backwards bends backwards. The search starts from the pose
    `qpos` (Q,). The result is None if the robot has fewer than four legs, if its legs are sprawled,
    if the limits of a leg's joints prevent the pose, or if not all feet would be on the floor.
    """
    # Legs are the limbs that touch the floor, or all limbs of a robot that lies on its trunk.
    ends = [model.body(name).id for name in limb_ends(model, qpos)]
    touching = {model.body_weldid[model.body(name).id] for name in touching_bodies(model, qpos)}
    on_feet = [end for end in ends if model.body_weldid[end] in touching]
    data = posed(model, qpos)
    legs = [leg for end in on_feet or ends if (leg := _leg(model, data, end)) is not None]
    if len(legs) < _LEAST_LEGS:
        return None
    bent = np.array(qpos)
    for leg in legs:
        if on_feet and abs(_angle(leg.thigh + leg.shank, leg.down)) > _SPRAWLED_RAD:
            return None
        angles = _bent(model, qpos, leg)
        if angles is None:
            return None
        bent[model.jnt_qposadr[[leg.hip, leg.knee]]] = angles
    bent = Followers(model).placed(bent)
    standing = touching_bodies(model, bent)
    return bent if all(model.body(leg.end).name in standing for leg in legs) else None


def _leg(model: mujoco.MjModel, data: mujoco.MjData, end: int) -> _Leg | None:
    """Return the leg that ends with the body `end`, or None if there is no such leg.

    The hip is the first hinge whose axis is not along x; the knee is the next parallel hinge.
    """
    joints = free_joints(model, ancestors(model, end)[:-1][::-1])
    hinges = [joint for joint in joints if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE]
    swings = [joint for joint in hinges if abs(data.xaxis[joint, 1]) > LATERAL]
    for hip, knee in itertools.pairwise(swings):
        axis = data.xaxis[hip]
        if abs(axis @ data.xaxis[knee]) <= _PARALLEL:
            continue
        first = np.cross(axis, (0.0, 0.0, 1.0))
        first /= np.linalg.norm(first)
        second = np.cross(axis, first)
        vectors = (
            data.xanchor[knee] - data.xanchor[hip],
            _foot(model, data, end, data.xanchor[knee]) - data.xanchor[knee],
            np.array([0.0, 0.0, -1.0]),
        )
        thigh, shank, down = (complex(vector @ first, vector @ second) for vector in vectors)
        knee_sign = math.copysign(1.0, float(axis @ data.xaxis[knee]))
        ahead = (float(first[0]), float(second[0]))
        return _Leg(hip, knee, end, thigh, shank, down / abs(second[2]), knee_sign, ahead)
    return None


def _bent(model: mujoco.MjModel, qpos: Vector, leg: _Leg) -> tuple[float, float] | None:
    """Return the angles of hip and knee that put the foot below the hip, or None."""
    upper, lower = abs(leg.thigh), abs(leg.shank)
    if min(upper, lower) <= _SHORTEST * (upper + lower):
        return None
    start = qpos[model.jnt_qposadr[[leg.hip, leg.knee]]]
    for share in _LENGTHS:
        reach = share * (upper + lower)
        cosine = (reach**2 - upper**2 - lower**2) / (2 * upper * lower)
        found = []
        for bend in (math.acos(cosine), -math.acos(cosine)) if abs(cosine) <= 1 else ():
            turn = math.remainder(bend - _angle(leg.thigh, leg.shank), 2 * math.pi)
            swing = _angle(leg.thigh + leg.shank * cmath.exp(1j * turn), leg.down)
            angles = (float(start[0]) + swing, float(start[1]) + leg.knee_sign * turn)
            knee = leg.thigh * cmath.exp(1j * swing)
            x = knee.real * leg.ahead[0] + knee.imag * leg.ahead[1]
            if _within(model, (leg.hip, leg.knee), angles):
                found.append((round(x, 6), angles))
        if found:
            return min(found)[1]
    return None


def _angle(first: complex, second: complex) -> float:
    """Return the angle (rad) from the first vector to the second."""
    return cmath.phase(second / first) if first != 0 else 0.0


def _foot(model: mujoco.MjModel, data: mujoco.MjData, end: int, knee: Vector) -> Vector:
    """Return the centre of the end body's farthest shape from the knee, or the body's origin."""
    places = list[Vector]()
    for geom in np.flatnonzero(model.geom_bodyid == end).tolist():
        kind, turn = model.geom_type[geom], data.geom_xmat[geom].reshape(3, 3)
        offsets: Sequence[Vector] = (np.zeros(3),)
        if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            along = turn[:, 2] * model.geom_size[geom, 1]
            offsets = (along, -along)
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            offsets = list(mesh_vertices(model, geom) @ turn.T)
        places += [data.geom_xpos[geom] + offset for offset in offsets]
    return max([*places, data.xpos[end]], key=lambda place: float(np.linalg.norm(place - knee)))


def _within(model: mujoco.MjModel, joints: Sequence[int], angles: Sequence[float]) -> bool:
    return all(
        not model.jnt_limited[joint]
        or model.jnt_range[joint, 0] <= angle <= model.jnt_range[joint, 1]
        for joint, angle in zip(joints, angles, strict=True)
    )
