"""Computes centre of mass, hips and angular momentum of a humanoid's poses."""

from __future__ import annotations

import mujoco
import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray

HIPS = ("right_thigh", "left_thigh")  # their origins are the hip joints


def com_and_hips(model: mujoco.MjModel, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centres of mass (n, 3) and right and left hips (n, 2, 3) in m for qpos (n, nq)."""
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
    """Return the rate of the angular momentum about the centre of mass, (n, 3) Nm.

    The rates are central differences, and one-sided differences at both ends.

    Args:
        model: the humanoid; body 1 is its root.
        poses: qpos (n, nq), n >= 3.
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
