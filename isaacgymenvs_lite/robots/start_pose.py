"""Computes the pose in which a robot begins, on the floor."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError, suggest, unknown
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.schema import plain

CLEARANCE = 0.001
"""Height in m of the lowest point of a robot above the floor in its start pose."""
_STANDING = ("home", "stand", "standing", "default")

_GEOM = mujoco.mjtGeom


def initial_positions(
    model: mujoco.MjModel, pose: Any, where: str
) -> dict[str, npt.NDArray[np.float64]]:
    """Return a dictionary from joint names to positions, in the pose of `RobotSettings`.

    Args:
        model: the model of the robot's file.
        pose: the name of a keyframe, a mapping from patterns of hinges to angles (rad), or None.
        where: key of the pose, for messages.

    Raises:
        ConfigError: the keyframe does not exist, a pattern matches no hinge, or an angle is not a
            number.
    """
    if pose is None or isinstance(pose, str):
        return _joint_positions(model, _keyframe(model, pose or None, where))
    pose = plain(pose)
    if not isinstance(pose, Mapping):
        raise ConfigError(
            f"{where}: got {pose!r}; expected the name of a keyframe, or angles of hinges in rad"
        )
    positions = _joint_positions(model, _keyframe(model, None, where))
    hinges = [name for name, values in positions.items() if len(values) == 1]
    for pattern, angle in reversed(list(pose.items())):  # the first pattern that matches counts
        matched = [name for name in hinges if fnmatchcase(name, str(pattern))]
        if not matched:
            raise ConfigError(
                f"{where}: '{pattern}' matches no hinge{suggest(str(pattern), hinges)};"
                f" hinges: {', '.join(hinges)}"
            )
        if isinstance(angle, bool) or not isinstance(angle, (int, float)) or abs(angle) > 100:
            raise ConfigError(f"{where}.{pattern}: got {angle!r}, expected an angle in rad")
        positions.update({name: np.array([float(angle)]) for name in matched})
    return positions


def _keyframe(model: mujoco.MjModel, name: str | None, where: str) -> int | None:
    """Return the id of the keyframe `name`; None selects the standing or the first keyframe."""
    names = [model.key(key).name for key in range(model.nkey)]
    if name is not None:
        if name not in names:
            raise ConfigError(unknown("keyframe", name, filter(None, names), f"see {where}"))
        return names.index(name)
    standing = [names.index(wanted) for wanted in _STANDING if wanted in names]
    return standing[0] if standing else (0 if names else None)


def _joint_positions(model: mujoco.MjModel, key: int | None) -> dict[str, npt.NDArray[np.float64]]:
    """Map joint names to positions in a keyframe, or else to the positions nearest to zero."""
    qpos = np.array(model.qpos0 if key is None else model.key_qpos[key])
    found = {}
    for joint, values in enumerate(np.split(qpos, model.jnt_qposadr[1:])):
        if len(values) == 1 and key is None and model.jnt_limited[joint]:
            values = np.clip(values, *model.jnt_range[joint])
        if not np.isfinite(values).all():
            raise ConfigError(f"keyframe {key}: joint '{model.joint(joint).name}' has no number")
        found[model.joint(joint).name] = values
    return found


def start_pose(
    model: mujoco.MjModel,
    positions: Mapping[str, npt.NDArray[np.float64]],
    height: float | None = None,
) -> npt.NDArray[np.float64]:
    """Return the start pose (Q,) of a robot with a free root at x = y = 0.

    Joints without a given position keep their initial position in the model; positions of followers
    are computed from their leaders. `height` is the height of the base in m; if it is None, the
    robot's lowest point is `CLEARANCE` above the floor.
    """
    qpos = np.array(model.qpos0)
    for joint in range(model.njnt):
        values = positions.get(model.joint(joint).name)
        if values is not None:
            begin = int(model.jnt_qposadr[joint])
            qpos[begin : begin + len(values)] = values
    qpos[:2] = 0
    norm = np.linalg.norm(qpos[3:7])
    qpos[3:7] = qpos[3:7] / norm if norm > 0 else (1, 0, 0, 0)
    qpos = Followers(model).placed(qpos)
    qpos[2] = start_height(model, qpos) if height is None else height
    return qpos


def start_height(model: mujoco.MjModel, qpos: npt.ArrayLike) -> float:
    """Return the height of the base (m) at which the lowest point is `CLEARANCE` above z = 0.

    The height in the pose `qpos` (Q,) has no influence.

    Raises:
        ConfigError: no geom can touch anything.
    """
    lows = lowest_points(model, posed(model, qpos))
    if not lows:
        raise ConfigError("no geom of the robot can touch anything: contype and conaffinity are 0")
    return float(np.asarray(qpos)[2] - min(lows.values()) + CLEARANCE)


def posed(model: mujoco.MjModel, qpos: npt.ArrayLike) -> mujoco.MjData:
    """Return the MjData of a model at a pose (Q,), after forward kinematics."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def lowest_points(model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, float]:
    """Return a dictionary from body ids to the lowest height (m) of the body's colliding geoms."""
    lows: dict[int, float] = {}
    for geom in geoms_that_touch(model):
        down = -data.geom_xmat[geom].reshape(3, 3)[2]  # the world's -z in the frame of the geom
        body = int(model.geom_bodyid[geom])
        low = float(data.geom_xpos[geom, 2] - reach_down(model, geom, down))
        lows[body] = min(low, lows.get(body, np.inf))
    return lows


def geoms_that_touch(model: mujoco.MjModel) -> list[int]:
    """Return those geoms of moving bodies that can touch other geoms."""
    paired = {*model.pair_geom1, *model.pair_geom2}
    return [
        geom
        for geom in range(model.ngeom)
        if model.body_weldid[model.geom_bodyid[geom]] != 0
        and (model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in paired)
    ]


def reach_down(
    model: mujoco.MjModel, geom: int, down: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64]:
    """Return the distances (...) in m from a geom's centre to its surface's farthest points.

    The directions (..., 3) are in the geom's frame.
    """
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == _GEOM.mjGEOM_CAPSULE:
        return size[0] + size[1] * np.abs(down[..., 2])
    if kind == _GEOM.mjGEOM_CYLINDER:
        return size[0] * np.hypot(down[..., 0], down[..., 1]) + size[1] * np.abs(down[..., 2])
    if kind == _GEOM.mjGEOM_ELLIPSOID:
        return np.linalg.norm(size * down, axis=-1)
    if kind == _GEOM.mjGEOM_BOX:
        return np.abs(down) @ size
    if kind == _GEOM.mjGEOM_MESH:
        return (down @ mesh_vertices(model, geom).T).max(axis=-1)
    radius = size[0] if kind == _GEOM.mjGEOM_SPHERE else model.geom_rbound[geom]
    return np.full(down.shape[:-1], radius)


def mesh_vertices(model: mujoco.MjModel, geom: int) -> npt.NDArray[np.float32]:
    """Return the vertices (K, 3) m of a mesh geom, in its frame."""
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    return model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
