"""Poses of a clip as joint coordinates: MuJoCo's qpos, or the humanoid's degrees of freedom.

Degrees of freedom (DOFs) are rotation vectors of ball joints and angles of hinges; qpos holds
quaternions wxyz in place of the rotation vectors, and the root's free joint.
"""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton, shipped_humanoid_with
from isaacgymenvs_lite.utils import rotations

_ROOT = 7  # numbers of the free joint: position, quaternion wxyz


def clip_to_qpos(clip: MotionClip) -> tuple[mujoco.MjModel, npt.NDArray[np.float64]]:
    """Return the humanoid of a clip, as a MuJoCo model, and the clip's poses, qpos (T, nq).

    Args:
        clip: of a shipped humanoid, its bodies in the humanoid's order, see `load_single_clip`.

    Raises:
        MotionFileError: no shipped humanoid has these bodies.
    """
    file = shipped_humanoid_with(clip.body_names)
    if file is None:
        raise MotionFileError(
            f"{clip.name}: no shipped humanoid has its {len(clip.body_names)} bodies"
            f" ({', '.join(clip.body_names)})"
        )
    path = str(paths.assets_dir() / file)
    poses = qpos_from_poses(Skeleton.from_mjcf(path), clip.root_translation, clip.local_rotation)
    return mujoco.MjModel.from_xml_path(path), poses


def qpos_from_poses(
    skeleton: Skeleton, root_translation: FloatArray, local_rotation: FloatArray
) -> npt.NDArray[np.float64]:
    """Return qpos (T, nq) of a humanoid whose root has the free joint.

    Args:
        skeleton: the tree and its joints; J bodies.
        root_translation: (T, 3) m, world position of the root.
        local_rotation: (T, J, 4) xyzw, rotations relative to the parent. Of a hinge, only the
            rotation about y is used.
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
    turns[..., 3] = 1.0  # bodies without a joint have their parent's rotation
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


def dofs_from_rotations(skeleton: Skeleton, local_rotation: FloatArray) -> FloatArray:
    """Return the DOFs (T, num_dofs) in rad of local rotations (T, J, 4) xyzw.

    Of a hinge, only the rotation about y is used.
    """
    turns = rotations.quat_log(torch.from_numpy(np.asarray(local_rotation, dtype=np.float64)))
    columns = [
        turns[:, body] if size == 3 else turns[:, body, 1:2]
        for body, size in zip(skeleton.dof_body_ids, skeleton.dof_sizes, strict=True)
    ]
    return torch.cat(columns, dim=-1).numpy()


def rotations_from_dofs(
    skeleton: Skeleton, root_rotation: FloatArray, dofs: FloatArray
) -> FloatArray:
    """Return the local rotations (T, J, 4) xyzw of root rotations (T, 4) and DOFs (T, num_dofs)."""
    vectors = torch.zeros((len(dofs), skeleton.num_bodies, 3), dtype=torch.float64)
    values = torch.from_numpy(np.asarray(dofs, dtype=np.float64))
    spans = itertools.pairwise(skeleton.dof_offsets)
    for body, (start, end) in zip(skeleton.dof_body_ids, spans, strict=True):
        vectors[:, body, 1 if end - start == 1 else slice(None)] = (
            values[:, start] if end - start == 1 else values[:, start:end]
        )
    turns = rotations.quat_from_angle_axis(vectors.norm(dim=-1), vectors)
    turns[:, 0] = torch.from_numpy(np.asarray(root_rotation, dtype=np.float64))
    return turns.numpy()
