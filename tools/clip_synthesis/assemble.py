"""Makes clips with velocities of solved poses, and solver targets of planned feet."""

from __future__ import annotations

import numpy as np
import torch

from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations


def clip_from_poses(
    name: str,
    fps: float,
    skeleton: Skeleton,
    root_translation: FloatArray,
    local_rotation: FloatArray,
    pad: int,
) -> MotionClip:
    """Make a clip of poses; its velocities are central differences without smoothing.

    Args:
        name: name of the clip.
        fps: frames per second.
        skeleton: the J bodies.
        root_translation: (pad + T + pad, 3) m.
        local_rotation: (pad + T + pad, J, 4) xyzw, relative to the parents.
        pad: number of additional frames at both ends for the differences, at least 1.
    """
    positions, turns = kinematics.forward_kinematics(
        skeleton.parent_indices, skeleton.local_translation, local_rotation, root_translation
    )
    inside = slice(pad, -pad)
    return MotionClip(
        name=name,
        fps=float(fps),
        body_names=skeleton.body_names,
        parent_indices=skeleton.parent_indices,
        local_translation=skeleton.local_translation.astype(np.float32),
        local_rotation=local_rotation[inside].astype(np.float32),
        root_translation=root_translation[inside].astype(np.float32),
        linear_velocity_w=(np.gradient(positions, axis=0) * fps)[inside].astype(np.float32),
        angular_velocity_w=_angular_velocities(turns, fps)[inside].astype(np.float32),
    )


def foot_frames(position: FloatArray, yaw: FloatArray, pitch: FloatArray) -> FloatArray:
    """Return quaternions wxyz and positions (n, 7) of a foot for `PoseSolver`.

    Args:
        position: (n, 3) m, the ankle in the world.
        yaw: (n) rad, direction of the foot about z.
        pitch: (n) rad, angle of the foot to the ground, toes up positive.
    """
    down = torch.from_numpy(-pitch)  # positive turns about y lower the toes
    turn = rotations.quat_from_euler_xyz(torch.zeros_like(down), down, torch.from_numpy(yaw))
    return np.concatenate((rotations.wxyz_from_xyzw(turn).numpy(), position), axis=1)


def _angular_velocities(turns: FloatArray, fps: float) -> FloatArray:
    """Return angular velocities (T, J, 3) in rad/s in the world from central differences."""
    q = torch.from_numpy(turns)
    padded = torch.cat((q[:1], q, q[-1:]))
    steps = rotations.quat_mul(padded[2:], rotations.quat_conjugate(padded[:-2]))
    spans = np.full((len(turns), 1, 1), 2.0)
    spans[[0, -1]] = 1.0
    return rotations.quat_log(steps).numpy() / spans * fps
