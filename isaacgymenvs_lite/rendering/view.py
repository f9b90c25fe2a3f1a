"""Computes the direction, distance and target of a camera that shows a model."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]

# Distances of the camera, as multiples of half the model's diagonal, from a moving robot and from a
# fixed robot.
_ROOM, _WHOLE = 2.6, 2.1
_MARGIN = 1.4  # for parts of the robot that are closer to the camera than the root
_MIN_DISTANCE_M, _MIN_FIXED_DISTANCE_M = 1.6, 0.6
# Least height (m) above the ground, in the default pose, at which a robot is a flying robot.
_FLIES_M = 0.3
_ELEVATION_DEG = -12.0
# Elevation and least distance of the camera on rough ground, so that steps and slopes are visible.
_TERRAIN_ELEVATION_DEG, _TERRAIN_DISTANCE_M = -20.0, 3.0
# Types of geoms that are floors and do not count in the size of a model.
_GROUNDS = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


@dataclass(frozen=True)
class View:
    """A camera; the defaults show a humanoid from its right side."""

    azimuth_deg: float = 90.0  # direction in which the camera looks, 90 along +y, 180 along -x
    elevation_deg: float = -4.0  # negative values look down
    distance_m: float = 2.5  # distance from the camera to its target
    # Height of the target above the ground, above the root of a flying robot, or above the origin
    # for a fixed model.
    look_at_height_m: float = 0.82
    # The target for a fixed model.
    centre_xy_m: tuple[float, float] = (0.0, 0.0)
    moves_about: bool = True  # whether the camera follows a root body
    flies: bool = False  # whether the camera also follows the root's height

    @classmethod
    def of_model(cls, model: mujoco.MjModel, aspect: float = 4 / 3) -> View:
        """Return a view of a model in its default pose, for pictures of this aspect ratio.

        The view shows a robot with a free root from the right, and any other model from the side
        where it looks longest.
        """
        moves_about = has_free_root(model)
        low, high = _bounds(model, moves_about)
        half_size = 0.5 * (high - low)
        half_diagonal = float(np.linalg.norm(half_size))
        if not moves_about:
            x, y, height = (float(value) for value in 0.5 * (low + high))
            azimuth_deg = 90.0 if half_size[0] > half_size[1] else 180.0
            distance_m = max(_MIN_FIXED_DISTANCE_M, _WHOLE * half_diagonal)
            return cls(azimuth_deg, _ELEVATION_DEG, distance_m, height, (x, y), moves_about=False)
        terrain = model.nhfield > 0
        flies = not terrain and float(low[2]) > _FLIES_M
        nearest_m = _TERRAIN_DISTANCE_M if terrain else _MIN_DISTANCE_M
        # In a narrow picture the robot's length determines the distance of the camera.
        half_angle = np.deg2rad(float(model.vis.global_.fovy) / 2)
        from_root = np.abs(np.array((low, high))[:, :2] - model.qpos0[:2])
        half_length = float(from_root.max())
        nearest_m = max(nearest_m, _MARGIN * half_length / (aspect * np.tan(half_angle)))
        return cls(
            elevation_deg=_TERRAIN_ELEVATION_DEG if terrain else _ELEVATION_DEG,
            distance_m=max(nearest_m, _ROOM * half_diagonal),
            look_at_height_m=0.0 if flies else float(half_size[2]),
            flies=flies,
        )


def aim_camera(camera: mujoco.MjvCamera, model: mujoco.MjModel) -> None:
    """Set a viewer's camera to the view of a model, so that the camera follows a robot."""
    view = View.of_model(model)
    camera.azimuth, camera.elevation = view.azimuth_deg, view.elevation_deg
    camera.distance = view.distance_m
    if view.moves_about:
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = int(model.jnt_bodyid[0])
    else:
        camera.lookat[:] = (*view.centre_xy_m, view.look_at_height_m)


def has_free_root(model: mujoco.MjModel) -> bool:
    """Return whether the first joint of a model is free."""
    return model.njnt > 0 and int(model.jnt_type[0]) == int(mujoco.mjtJoint.mjJNT_FREE)


def _bounds(model: mujoco.MjModel, moves_about: bool) -> tuple[Points, Points]:
    """Return the smallest and largest coordinates (3,) m of a model's shapes in its default pose.

    If `moves_about` is True, only shapes of the first body and its descendants count.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    root = int(model.jnt_bodyid[0]) if model.njnt > 0 else 0
    corners = [np.zeros((1, 3))]
    for geom in range(model.ngeom):
        if int(model.geom_type[geom]) in _GROUNDS:
            continue
        if moves_about and model.body_rootid[model.geom_bodyid[geom]] != root:
            continue
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
        turn = data.geom_xmat[geom].reshape(3, 3)
        corners.append(data.geom_xpos[geom] + (centre + signs * half) @ turn.T)
    points = np.concatenate(corners[1:] or corners)
    return points.min(axis=0), points.max(axis=0)
