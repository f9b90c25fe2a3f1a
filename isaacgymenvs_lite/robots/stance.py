"""Bent legs for a robot of four or more legs whose file has no keyframe.

Straight legs are a poor start: they push the trunk nowhere but up, and targets of the drives are
offsets from it.
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
from isaacgymenvs_lite.robots.limbs import limb_ends, touching_bodies

_LEAST_LEGS = 4
# Of the straight leg, between hip and foot; the others where joints do not reach the first.
_LENGTHS = (0.75, 0.8, 0.85, 0.9, 0.65, 0.55)
_SHORTEST = 0.1  # of the leg's length: a shorter link is no thigh or shank
_PARALLEL = 0.95  # cosine of the angle between the axes of a hip and its knee
_LATERAL = 0.7  # share of a hinge's axis along y with which it swings a leg fore and aft
_SPRAWLED_RAD = 0.7  # from the vertical: legs that stand like this are a spider's, and stay

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Leg:
    """Two hinges with parallel level axes, and the foot that they move.

    Attributes:
        hip: number of the hinge that swings the leg.
        knee: number of the next hinge whose axis is parallel.
        end: number of the last body.
    """

    hip: int
    knee: int
    end: int


def bend_legs(model: mujoco.MjModel, qpos: Vector) -> Vector | None:
    """Return the pose with each foot below its hip at 0.75 of the leg's length, or None.

    Knees are behind where a leg can bend to both sides. None: the robot has fewer than four legs,
    stands with them sprawled, one of them cannot do so within the limits of its joints, or not all
    feet are on the floor then.

    Args:
        model: of a robot with a free root.
        qpos: (Q,) the pose to start from, such as zero angles.
    """
    legs, on_feet = _legs(model, qpos)
    if len(legs) < _LEAST_LEGS:
        return None
    bent = np.array(qpos)
    for leg in legs:
        plane = _LegPlane.of(model, qpos, leg)
        if on_feet and abs(plane.lean()) > _SPRAWLED_RAD:
            return None
        angles = plane.bend(model, qpos)
        if angles is None:
            return None
        bent[model.jnt_qposadr[[leg.hip, leg.knee]]] = angles
    bent = Followers(model).placed(bent)
    standing = touching_bodies(model, bent)
    stands = all(model.body(leg.end).name in standing for leg in legs)
    return bent if stands else None


def _legs(model: mujoco.MjModel, qpos: Vector) -> tuple[list[_Leg], bool]:
    """Return the limbs that touch the floor, or all limbs of a robot that lies on its trunk.

    And whether they touch it.
    """
    ends = [model.body(name).id for name in limb_ends(model, qpos)]
    touching = {model.body_weldid[model.body(name).id] for name in touching_bodies(model, qpos)}
    standing = [end for end in ends if model.body_weldid[end] in touching]
    data = _posed(model, qpos)
    legs = [_leg(model, data, end) for end in standing or ends]
    return [leg for leg in legs if leg is not None], bool(standing)


def _leg(model: mujoco.MjModel, data: mujoco.MjData, end: int) -> _Leg | None:
    """Return the leg of an end: its first hinge across x and the next one that is parallel."""
    swings = [joint for joint in _hinges(model, end) if abs(data.xaxis[joint, 1]) > _LATERAL]
    for hip, knee in itertools.pairwise(swings):
        if abs(data.xaxis[hip] @ data.xaxis[knee]) > _PARALLEL:
            return _Leg(hip, knee, end)
    return None


def _hinges(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the hinges that move freely between the root and a body, from the root on."""
    found: list[int] = []
    followers = Followers(model).joints
    while model.body_parentid[body] != 0:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        own = range(first, first + count)
        hinges = [j for j in own if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
        found[:0] = [joint for joint in hinges if joint not in followers]
        body = int(model.body_parentid[body])
    return found


def _posed(model: mujoco.MjModel, qpos: Vector) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


@dataclass(frozen=True)
class _LegPlane:
    """A leg in the plane that its hip swings in; a turn about the hip's axis adds to the angle.

    Attributes:
        leg: the leg.
        thigh: from hip to knee, m.
        shank: from knee to foot, m.
        down: a unit vector.
        knee_sign: -1 if the knee's axis is opposed to the hip's.
        ahead: how far the plane's first and second direction point along x.
    """

    leg: _Leg
    thigh: complex
    shank: complex
    down: complex
    knee_sign: float
    ahead: tuple[float, float]

    @classmethod
    def of(cls, model: mujoco.MjModel, qpos: Vector, leg: _Leg) -> _LegPlane:
        """Return the plane of a leg in a pose (Q,)."""
        data = _posed(model, qpos)
        hip, knee, axis = data.xanchor[leg.hip], data.xanchor[leg.knee], data.xaxis[leg.hip]
        first = np.cross(axis, (0.0, 0.0, 1.0))
        first /= np.linalg.norm(first)
        second = np.cross(axis, first)

        def inside(vector: Vector) -> complex:
            return complex(vector @ first, vector @ second)

        return cls(
            leg=leg,
            thigh=inside(knee - hip),
            shank=inside(_foot(model, data, leg, knee) - knee),
            down=inside(np.array([0.0, 0.0, -1.0])) / abs(second[2]),
            knee_sign=math.copysign(1.0, float(axis @ data.xaxis[leg.knee])),
            ahead=(float(first[0]), float(second[0])),
        )

    def lean(self) -> float:
        """Return the angle from straight down to the foot, rad."""
        return _angle(self.thigh + self.shank, self.down)

    def bend(self, model: mujoco.MjModel, qpos: Vector) -> tuple[float, float] | None:
        """Return the angles of hip and knee that put the foot below the hip, or None."""
        upper, lower = abs(self.thigh), abs(self.shank)
        if min(upper, lower) <= _SHORTEST * (upper + lower):
            return None
        start = qpos[model.jnt_qposadr[[self.leg.hip, self.leg.knee]]]
        for share in _LENGTHS:
            reach = share * (upper + lower)
            cosine = (reach**2 - upper**2 - lower**2) / (2 * upper * lower)
            bends = (math.acos(cosine), -math.acos(cosine)) if abs(cosine) <= 1 else ()
            found = []
            for bend in bends:
                turn = math.remainder(bend - _angle(self.thigh, self.shank), 2 * math.pi)
                swing = _angle(self.thigh + self.shank * cmath.exp(1j * turn), self.down)
                angles = (float(start[0]) + swing, float(start[1]) + self.knee_sign * turn)
                knee = self.thigh * cmath.exp(1j * swing)
                x = knee.real * self.ahead[0] + knee.imag * self.ahead[1]
                if _within(model, (self.leg.hip, self.leg.knee), angles):
                    found.append((round(x, 6), angles))
            if found:
                return min(found)[1]
        return None


def _angle(first: complex, second: complex) -> float:
    """Return the angle of the turn from one vector to another, rad."""
    return cmath.phase(second / first) if first != 0 else 0.0


def _foot(model: mujoco.MjModel, data: mujoco.MjData, leg: _Leg, knee: Vector) -> Vector:
    """Return the centre of the leg's shape that is farthest from the knee, or its end."""
    geoms = np.flatnonzero(model.geom_bodyid == leg.end)
    places = [data.geom_xpos[geom] + end for geom in geoms for end in _ends(model, data, int(geom))]
    places.append(data.xpos[leg.end])
    return max(places, key=lambda place: float(np.linalg.norm(place - knee)))


def _ends(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Sequence[Vector]:
    """Return places of a geom from its centre: the ends of what is long."""
    if model.geom_type[geom] in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
        along = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
        return (along, -along)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        return list(vertices @ data.geom_xmat[geom].reshape(3, 3).T)
    return (np.zeros(3),)


def _within(model: mujoco.MjModel, joints: Sequence[int], angles: Sequence[float]) -> bool:
    return all(
        not model.jnt_limited[joint]
        or model.jnt_range[joint, 0] <= angle <= model.jnt_range[joint, 1]
        for joint, angle in zip(joints, angles, strict=True)
    )
