"""Measures ground force, pressure and self-contacts of a clip with the MuJoCo model."""

from __future__ import annotations

import mujoco
import numpy as np

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import qpos_from_poses
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis import checks, dynamics

_LEAST_FORCE = 0.25  # body weights; a smaller force has no meaningful centre of pressure
_FLAT = 1e-12  # m^2; corners with smaller cross products lie on one line


def ground_force(clip: MotionClip, skeleton: Skeleton, model: mujoco.MjModel) -> FloatArray:
    """Return the force (T - 2, 3) of the ground in body weights and world axes.

    Newton's law gives the force for all frames except the first and the last. It is (0, 0, 1) in
    standing and 0 in flight.
    """
    com = dynamics.com_and_hips(model, clip_qpos(clip, skeleton))[0]
    acceleration = np.diff(com, n=2, axis=0) * clip.fps**2
    gravity = -float(model.opt.gravity[2])
    return acceleration / gravity + (0.0, 0.0, 1.0)


def pressure_outside(clip: MotionClip, skeleton: Skeleton, model: mujoco.MjModel) -> FloatArray:
    """Return the distances (T - 4) in m of the centre of pressure from the soles on the ground.

    The first and the last two frames are left out. The distance is measured to the convex hull of
    the sole corners on the ground, and it is 0 inside. It is NaN with fewer than two corners or
    nearly without force. The ground force acts at the centre of pressure and changes the angular
    momentum of the whole body (Vukobratovic and Borovac, Int. J. Humanoid Robotics 1 (2004)
    157-173).
    """
    poses = clip_qpos(clip, skeleton)
    com = dynamics.com_and_hips(model, poses)[0][1:-1]
    weight = float(model.body_subtreemass[1]) * -float(model.opt.gravity[2])
    moment = dynamics.moments(model, poses, clip.fps)[1:-1] / weight
    force = ground_force(clip, skeleton, model)
    carried = force[:, 2] > _LEAST_FORCE
    up = np.where(carried, force[:, 2], np.nan)
    x = com[:, 0] - (com[:, 2] * force[:, 0] + moment[:, 1]) / up
    y = com[:, 1] - (com[:, 2] * force[:, 1] - moment[:, 0]) / up
    corners = checks.sole_corners(skeleton, *clip.global_poses()).reshape(clip.num_frames, -1, 3)
    # The force is a difference of three frames. A corner counts if it touches in one of them.
    low = corners[..., 2] < checks.CONTACT_HEIGHT_M
    low = low[:-2] | low[1:-1] | low[2:]
    points = np.stack((x, y), axis=-1)
    rows = zip(points, corners[1:-1, :, :2], low, strict=True)
    return np.array([outside(point, ground[touch]) for point, ground, touch in rows])[1:-1]


def outside(point: FloatArray, corners: FloatArray) -> float:
    """Return the distance in m of a point (2) to the convex hull of corners (n, 2), 0 inside.

    The distance is NaN for fewer than 2 corners or a point with NaN.
    """
    if len(corners) < 2 or np.isnan(point).any():
        return float("nan")
    # A line through two corners bounds the hull if all other corners are on one side of it.
    away = corners - point
    first, second = (index.ravel() for index in np.triu_indices(len(corners), 1))
    start, way = away[first], away[second] - away[first]
    length = np.hypot(way[:, 0], way[:, 1])
    start, way, length = start[length > 0.0], way[length > 0.0], length[length > 0.0]
    side = _cross(way[:, None], away[None] - start[:, None])
    own = _cross(way, -start)
    beyond = (side >= -_FLAT).all(axis=1) & (own < 0.0)
    beyond |= (side <= _FLAT).all(axis=1) & (own > 0.0)
    is_line = bool((np.abs(side) <= _FLAT).all())
    if not (is_line or beyond.any()):
        return 0.0
    share = np.clip(-(start * way).sum(axis=1) / length**2, 0.0, 1.0)
    return float(np.linalg.norm(start + share[:, None] * way, axis=1).min())


def deepest_self_contact(clip: MotionClip, skeleton: Skeleton, model: mujoco.MjModel) -> float:
    """Return the largest penetration in m of two bodies, 0 without contacts.

    Neighbouring bodies and the floor do not count.
    """
    data = mujoco.MjData(model)
    deepest = 0.0
    for pose in clip_qpos(clip, skeleton):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for i in range(data.ncon):
            bodies = model.geom_bodyid[data.contact.geom[i]]
            if bodies.min() > 0:
                deepest = max(deepest, -float(data.contact.dist[i]))
    return deepest


def clip_qpos(clip: MotionClip, skeleton: Skeleton) -> FloatArray:
    """Return MuJoCo's positions (T, nq) of the frames of a clip."""
    return qpos_from_poses(skeleton, clip.root_translation, clip.local_rotation)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
