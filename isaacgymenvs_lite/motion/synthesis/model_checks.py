"""Measured figures of a clip that need the MuJoCo model: ground force, contacts with itself."""

from __future__ import annotations

import mujoco
import numpy as np

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import qpos_from_poses
from isaacgymenvs_lite.motion.skeleton import Skeleton


def ground_force(clip: MotionClip, skeleton: Skeleton, model: mujoco.MjModel) -> FloatArray:
    """Return the force (T - 2, 3) that the ground must give, in body weights and world axes.

    By Newton's law from the path of the centre of mass, for all frames but the first and the last:
    (0, 0, 1) in standing, 0 in flight, never downwards.
    """
    data = mujoco.MjData(model)
    com = np.empty((clip.num_frames, 3))
    for frame, pose in enumerate(_poses(clip, skeleton)):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        com[frame] = data.subtree_com[1]
    acceleration = np.diff(com, n=2, axis=0) * clip.fps**2
    gravity = -float(model.opt.gravity[2])
    return acceleration / gravity + (0.0, 0.0, 1.0)


def deepest_self_contact(clip: MotionClip, skeleton: Skeleton, model: mujoco.MjModel) -> float:
    """Return how deep in m bodies go into each other at most; 0 where none touch.

    Bodies joined to each other do not count, nor does the floor.
    """
    data = mujoco.MjData(model)
    deepest = 0.0
    for pose in _poses(clip, skeleton):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for i in range(data.ncon):
            bodies = model.geom_bodyid[data.contact.geom[i]]
            if bodies.min() > 0:
                deepest = max(deepest, -float(data.contact.dist[i]))
    return deepest


def _poses(clip: MotionClip, skeleton: Skeleton) -> FloatArray:
    return qpos_from_poses(skeleton, clip.root_translation, clip.local_rotation)
