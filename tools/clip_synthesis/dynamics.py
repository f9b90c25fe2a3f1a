"""Mass properties of a humanoid's poses: centre of mass, hips, angular momentum."""

from __future__ import annotations

import mujoco
import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray

HIPS = ("right_thigh", "left_thigh")  # the bodies whose origins are the hip joints


def centres_of_mass(model: mujoco.MjModel, poses: FloatArray) -> FloatArray:
    """Return the centres of mass (n, 3) m in the world of poses qpos (n, nq)."""
    return com_and_hips(model, poses)[0]


def com_and_hips(model: mujoco.MjModel, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centres of mass (n, 3) and right and left hips (n, 2, 3), m, of poses qpos (n, nq)."""
    data = mujoco.MjData(model)
    com, hips = np.empty((len(poses), 3)), np.empty((len(poses), 2, 3))
    for i, pose in enumerate(poses):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        com[i] = data.subtree_com[1]
        hips[i] = [data.body(name).xpos for name in HIPS]
    return com, hips


def moments(model: mujoco.MjModel, poses: FloatArray, fps: float) -> FloatArray:
    """Return the rate of angular momentum about the centre of mass (n, 3) Nm, by differences.

    Args:
        model: the humanoid; body 1 is its root.
        poses: qpos (n, nq), n >= 3, `fps` per second. Differences are one-sided at both ends.
        fps: frames per second.
    """
    data = mujoco.MjData(model)
    momentum = np.empty((len(poses), 3))
    velocity = np.empty(model.nv)
    for i, pose in enumerate(poses):
        before, after = max(i - 1, 0), min(i + 1, len(poses) - 1)
        mujoco.mj_differentiatePos(
            model, velocity, (after - before) / fps, poses[before], poses[after]
        )
        data.qpos[:], data.qvel[:] = pose, velocity
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        momentum[i] = data.subtree_angmom[1]
    return np.asarray(np.gradient(momentum, axis=0)) * fps
