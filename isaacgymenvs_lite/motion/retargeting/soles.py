"""The points of a robot's foot that can touch the ground, from the geoms of its model."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.kinematics import FloatArray

# Points this much higher than the lowest one, with the robot upright, belong to the sole.
_SOLE_M = 0.015
# Seen from above, a sole with more points is described by those that reach furthest in so many
# directions.
_DIRECTIONS = 12
_Geom = mujoco.mjtGeom
_ENDS = tuple(itertools.product((-1.0, 1.0), repeat=3))


def find_sole(
    model: mujoco.MjModel, start: FloatArray, foot: str
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return centres (K, 3) m, seen from the foot in world axes, and radii (K,) of its sole.

    Corners of boxes, ends of capsules and cylinders, spheres, vertices of meshes, of the foot and
    of bodies that it carries. Geoms that do not collide count only if no other exists.

    Args:
        model: the compiled model.
        start: (nq,), a pose in which the robot stands upright with flat feet.
        foot: name of the body.

    Raises:
        ConfigError: it has no geoms.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_kinematics(model, data)
    body = model.body(foot).id
    carried = {i for i in range(1, model.nbody) if _carries(model, body, i)}
    geoms = [i for i in range(model.ngeom) if int(model.geom_bodyid[i]) in carried]
    colliding = [i for i in geoms if model.geom_contype[i] or model.geom_conaffinity[i]]
    parts = [_points(model, data, geom) for geom in colliding or geoms]
    if not parts:
        raise ConfigError(f"the foot '{foot}' of the robot has no geoms: where is its sole?")
    centres = np.concatenate([points for points, _ in parts])
    radii = np.concatenate([np.full(len(points), radius) for points, radius in parts])
    heights = centres[:, 2] - radii
    low = np.flatnonzero(heights < heights.min() + _SOLE_M)
    low = low[_outermost(centres[low, :2])]
    return centres[low] - data.xpos[body], radii[low]


def _carries(model: mujoco.MjModel, body: int, other: int) -> bool:
    while other > body:
        other = int(model.body_parentid[other])
    return other == body


def _points(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int
) -> tuple[npt.NDArray[np.float64], float]:
    """Return points (K, 3) m in the world, and the radius of the balls about them."""
    kind, size = _Geom(int(model.geom_type[geom])), model.geom_size[geom]
    radius = 0.0
    if kind == _Geom.mjGEOM_SPHERE:
        local, radius = np.zeros((1, 3)), float(size[0])
    elif kind == _Geom.mjGEOM_CAPSULE:
        local, radius = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), float(size[0])
    elif kind == _Geom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        local = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(np.float64)
    else:  # corners of a box, and of the box around a cylinder or an ellipsoid
        half = (size[0], size[0], size[1]) if kind == _Geom.mjGEOM_CYLINDER else size
        local = np.array(_ENDS) * half
    return local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom], radius


def _outermost(points: FloatArray) -> list[int]:
    """Return the indices of the points (K, 2) that reach furthest in evenly spread directions."""
    if len(points) <= _DIRECTIONS:
        return list(range(len(points)))
    angles = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    ways = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return sorted({int(i) for i in (points @ ways.T).argmax(axis=0)})
