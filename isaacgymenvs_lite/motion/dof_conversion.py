"""Poses of a clip as degrees of freedom: rotation vectors of ball joints, angles of hinges."""

from __future__ import annotations

import itertools

import numpy as np
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations


def dofs_from_rotations(skeleton: Skeleton, local_rotation: FloatArray) -> FloatArray:
    """Return the DOFs (T, num_dofs) in rad of local rotations (T, J, 4) xyzw.

    Of a hinge, the part of the rotation about y is taken.
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
