"""Poses of a clip as joint positions (qpos) of the MuJoCo model, and back."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations

_ROOT = 7  # numbers of the free joint: position, quaternion wxyz


def qpos_from_poses(
    skeleton: Skeleton, root_translation: FloatArray, local_rotation: FloatArray
) -> npt.NDArray[np.float64]:
    """Return qpos (T, nq) of a humanoid whose root has the free joint.

    Args:
        skeleton: the tree and its joints; J bodies.
        root_translation: (T, 3) m, world position of the root.
        local_rotation: (T, J, 4) xyzw, rotations relative to the parent. Of a hinge, the rotation
            about y is taken.
    """
    turns = torch.from_numpy(np.ascontiguousarray(local_rotation, dtype=np.float64))
    root_translation = np.asarray(root_translation, dtype=np.float64)
    parts = [root_translation, rotations.wxyz_from_xyzw(turns[:, 0]).numpy()]
    for body, size in zip(skeleton.dof_body_ids, skeleton.dof_sizes, strict=True):
        if size == 1:
            parts.append(rotations.quat_log(turns[:, body])[:, 1:2].numpy())
        else:
            parts.append(rotations.wxyz_from_xyzw(turns[:, body]).numpy())
    return np.concatenate(parts, axis=1)


def poses_from_qpos(
    skeleton: Skeleton, qpos: FloatArray
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return root positions (T, 3) m and local rotations (T, J, 4) xyzw of qpos (T, nq)."""
    values = torch.from_numpy(np.ascontiguousarray(qpos, dtype=np.float64))
    turns = torch.zeros((len(values), skeleton.num_bodies, 4), dtype=torch.float64)
    turns[..., 3] = 1.0  # bodies without a joint keep their place in the parent
    turns[:, 0] = rotations.xyzw_from_wxyz(values[:, 3:_ROOT])
    column = _ROOT
    for body, size in zip(skeleton.dof_body_ids, skeleton.dof_sizes, strict=True):
        if size == 1:
            half = 0.5 * values[:, column]
            turns[:, body, 1], turns[:, body, 3] = half.sin(), half.cos()
            column += 1
        else:
            turns[:, body] = rotations.xyzw_from_wxyz(values[:, column : column + 4])
            column += 4
    return values[:, :3].numpy(), turns.numpy()
