"""Adds markers to pictures of robots, for example an arrow in the target direction."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

Point = tuple[float, float, float]
"""A position (m) in the world frame."""
Colour = tuple[float, float, float]
"""Red, green and blue components from 0 to 1."""

# This colour differs from the grey ground and the blue sky of the humanoids' scenes.
GO_COLOUR: Colour = (0.9, 0.15, 0.1)
FACE_COLOUR: Colour = (1.0, 0.8, 0.1)
ACTUAL_COLOUR: Colour = (0.1, 0.7, 0.2)

_ARROW_WIDTH_M = 0.03
_OVERLAY_OPACITY = 0.35
_SOLID_OPACITY = 0.6


@dataclass(frozen=True)
class Arrow:
    """An arrow from one point to another."""

    start_w: Point
    end_w: Point
    colour: Colour


@dataclass(frozen=True)
class Sphere:
    """A sphere about a point."""

    centre_w: Point
    radius_m: float
    colour: Colour


@dataclass(frozen=True)
class Solid:
    """A translucent box, ellipsoid or capsule, with the sizes of MuJoCo's geoms.

    `kind` is a value of `mujoco.mjtGeom`.
    """

    kind: int
    size_m: tuple[float, float, float]
    centre_w: Point
    rot_wxyz: tuple[float, float, float, float]
    colour: Colour


Marker = Arrow | Sphere | Solid


def arrow_on_ground(
    xy_w: tuple[float, float], direction: tuple[float, float], colour: Colour
) -> Arrow:
    """Return an arrow just above the ground next to a character; `direction` has length 1."""
    (x, y), (dx, dy) = xy_w, direction
    near, far, height = 0.3, 1.0, 0.03
    return Arrow(
        (x + near * dx, y + near * dy, height), (x + far * dx, y + far * dy, height), colour
    )


def add_markers(scene: mujoco.MjvScene, markers: Iterable[Marker]) -> None:
    """Add markers to a scene until the scene is full."""
    for marker in markers:
        if scene.ngeom == scene.maxgeom:
            return
        if isinstance(marker, Arrow):
            geom = add_geom(scene, mujoco.mjtGeom.mjGEOM_ARROW, colour=marker.colour)
            ends = (np.array(marker.start_w), np.array(marker.end_w))
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, _ARROW_WIDTH_M, *ends)
        elif isinstance(marker, Solid):
            place_w = np.array(marker.centre_w)
            geom = add_geom(scene, marker.kind, np.array(marker.size_m), place_w, marker.colour)
            matrix = np.empty(9)
            mujoco.mju_quat2Mat(matrix, np.array(marker.rot_wxyz))
            geom.mat[:] = matrix.reshape(3, 3)
            geom.rgba[3] = _SOLID_OPACITY
        else:
            size = np.full(3, marker.radius_m)
            place_w = np.array(marker.centre_w)
            add_geom(scene, mujoco.mjtGeom.mjGEOM_SPHERE, size, place_w, marker.colour)


def add_geom(
    scene: mujoco.MjvScene,
    kind: int,
    size: npt.NDArray[np.float64] | None = None,
    place_w: npt.NDArray[np.float64] | None = None,
    colour: Colour = (1.0, 1.0, 1.0),
) -> mujoco.MjvGeom:
    """Add a shape to a scene that is not full, and return the shape.

    The type is a value of `mujoco.mjtGeom`. `size` (3,) m has the same meaning as the size of
    MuJoCo's geoms of this type; `place_w` (3,) m is the centre.
    """
    geom = scene.geoms[scene.ngeom]
    size = np.zeros(3) if size is None else size
    place_w = np.zeros(3) if place_w is None else place_w
    ink = np.array((*colour, 1.0), dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, size, place_w, np.eye(3).ravel(), ink)
    scene.ngeom += 1
    return geom


class RobotOverlay:
    """Adds a translucent robot to a scene, for example the reference motion of an imitation.

    Args:
        model: model of the scene. The robot is the tree of the model's first joint.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._option, self._perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()

    def add_to(self, scene: mujoco.MjvScene, qpos: npt.NDArray[np.float64]) -> None:
        """Add the robot in the pose `qpos` (nq,) to a scene."""
        model, data = self._model, self._data
        root = int(model.jnt_bodyid[0])
        data.qpos[: len(qpos)] = qpos
        mujoco.mj_kinematics(model, data)
        first = scene.ngeom
        moving = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
        mujoco.mjv_addGeoms(model, data, self._option, self._perturbation, moving, scene)
        for index in range(first, scene.ngeom):
            geom = scene.geoms[index]
            body = int(model.geom_bodyid[geom.objid])
            of_robot = int(model.body_rootid[body]) == root
            geom.rgba[3] = _OVERLAY_OPACITY if of_robot else 0.0
            geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
