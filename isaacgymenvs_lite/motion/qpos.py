"""Converts between body rotations, MuJoCo's qpos, and degrees of freedom (DOFs).

DOFs are rotation vectors of ball joints and angles of hinges. A qpos starts with the root's free
joint, and contains quaternions wxyz of ball joints.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray, local_rotations
from isaacgymenvs_lite.motion.skeleton import Skeleton, shipped_humanoid_with
from isaacgymenvs_lite.robots.followers import TOLERANCE_RAD
from isaacgymenvs_lite.utils import rotations
from isaacgymenvs_lite.utils.kinematics import Floats, Kinematics

_log = logging.getLogger(__name__)
_ROOT = 7  # qpos values of the free joint: position and quaternion wxyz


def clip_to_qpos(
    clip: MotionClip, skeleton: Skeleton | None = None
) -> tuple[mujoco.MjModel, npt.NDArray[np.float64]]:
    """Return the MuJoCo model of a clip and the clip's poses qpos (T, nq).

    If `skeleton`, the robot's, is None, the shipped humanoid with the clip's bodies is used.
    """
    if skeleton is None:
        file = shipped_humanoid_with(clip.body_names)
        if file is None:
            raise MotionFileError(
                f"{clip.name}: no shipped humanoid has its {len(clip.body_names)} bodies"
                f" ({', '.join(clip.body_names)})"
            )
        skeleton = Skeleton.from_mjcf(paths.assets_dir() / file)
    return skeleton.model, qpos_from_clip(skeleton, clip)


class BodyPoses:
    """Forward kinematics of a robot's bodies for many qpos in float32."""

    def __init__(self, skeleton: Skeleton) -> None:
        model = skeleton.model
        root = int(model.jnt_bodyid[0])
        self._bodies = slice(root - 1, root - 1 + skeleton.num_bodies)
        self._kinematics = Kinematics(model, self._bodies.stop)
        self._qpos0 = model.qpos0.astype(np.float32)

    def at(self, qpos: FloatArray) -> tuple[Floats, Floats]:
        """Return world positions (3, J, n) m and rotations (4, J, n) xyzw at qpos (n, nq).

        The last columns of qpos belong to objects and may be left out.
        """
        whole = np.repeat(self._qpos0[:, None], len(qpos), axis=1)
        whole[: qpos.shape[1]] = qpos.T
        positions = np.empty((3, self._bodies.stop, len(qpos)), dtype=np.float32)
        turns = np.empty((4, self._bodies.stop, len(qpos)), dtype=np.float32)
        self._kinematics.poses(whole, positions, turns)
        return positions[:, self._bodies], turns[:, self._bodies]


def clip_from_qpos(name: str, fps: float, skeleton: Skeleton, qpos: FloatArray) -> MotionClip:
    """Make a clip of a robot from qpos (T, nq) by MuJoCo's kinematics.

    The columns of objects may be left out. The angles of follower joints are computed from their
    leader joints, and may be NaN in `qpos`. A warning names followers whose angles in `qpos` differ
    from the computed angles.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    num_columns = skeleton.qpos_addresses[-1]
    if skeleton.followers is not None and qpos.ndim == 2 and qpos.shape[1] >= num_columns:
        followers, given = skeleton.followers, qpos
        qpos = followers.placed(given)
        for joint, column in zip(followers.names, followers.columns, strict=True):
            off_rad = np.fmax.reduce(np.abs(qpos[:, column] - given[:, column]), initial=0.0)
            if off_rad > TOLERANCE_RAD:
                _log.warning(
                    "%s: joint '%s' follows another joint in the model but is up to %.3g rad off;"
                    " its angle is computed from its leader's",
                    *(name, joint, off_rad),
                )
    if qpos.ndim != 2 or qpos.shape[1] < num_columns or not np.isfinite(qpos).all():
        raise MotionFileError(
            f"{name}: qpos has shape {qpos.shape}, expected finite numbers (frames, {num_columns}):"
            f" position, rotation and {len(skeleton.dof_body_ids)} joints of the robot"
        )
    offsets, turns = local_poses(skeleton, qpos)
    root, dofs = qpos[:, :3], dofs_from_qpos(skeleton, qpos)
    names, parents = skeleton.body_names, skeleton.parent_indices
    return MotionClip.from_poses(name, fps, names, parents, offsets, turns, root, dofs)


def qpos_from_clip(skeleton: Skeleton, clip: MotionClip) -> npt.NDArray[np.float64]:
    """Return qpos (T, nq) without objects of a clip whose bodies have the skeleton's order."""
    if clip.dof_pos is None:
        return qpos_from_poses(skeleton, clip.root_translation, clip.local_rotation)
    return qpos_from_dofs(skeleton, clip.root_translation, clip.local_rotation[:, 0], clip.dof_pos)


def qpos_from_dofs(
    skeleton: Skeleton, root_translation: FloatArray, root_rotation: FloatArray, dofs: FloatArray
) -> npt.NDArray[np.float64]:
    """Return qpos (T, nq) for root positions (T, 3) m, rotations (T, 4) xyzw, DOFs (T, D) rad."""
    values = np.asarray(dofs, dtype=np.float64)
    turns = rotations.wxyz_from_xyzw(joint_rotations(skeleton, values)).numpy()
    root = torch.from_numpy(np.array(root_rotation, dtype=np.float64))
    parts = [np.asarray(root_translation, np.float64), rotations.wxyz_from_xyzw(root).numpy()]
    for group, (start, end) in enumerate(itertools.pairwise(skeleton.dof_offsets)):
        parts.append(values[:, start:end] if end - start == 1 else turns[:, group])
    return np.concatenate(parts, axis=1)


def qpos_from_poses(
    skeleton: Skeleton, root_translation: FloatArray, local_rotation: FloatArray
) -> npt.NDArray[np.float64]:
    """Return qpos (T, nq) for root positions (T, 3) m and local rotations (T, J, 4) xyzw.

    Rotations of a hinge out of its axis are dropped. Raises MotionFileError if a body has several
    joints, because the body's rotation does not determine their angles.
    """
    turns = turned_by_joints(skeleton, local_rotation)
    root = rotations.wxyz_from_xyzw(turns[:, 0]).numpy()
    parts = [np.asarray(root_translation, np.float64), root]
    for group, body in enumerate(skeleton.dof_body_ids):
        if skeleton.dof_sizes[group] == 1:
            parts.append(_hinge_angle(skeleton, group, rotations.quat_log(turns[:, body])).numpy())
        else:
            parts.append(rotations.wxyz_from_xyzw(turns[:, body]).numpy())
    return np.concatenate(parts, axis=1)


def poses_from_qpos(
    skeleton: Skeleton, qpos: FloatArray
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return root positions (T, 3) m and local rotations (T, J, 4) xyzw for qpos (T, nq)."""
    values = torch.from_numpy(np.ascontiguousarray(qpos, dtype=np.float64))
    joints = torch.zeros((len(values), len(skeleton.dof_body_ids), 4), dtype=torch.float64)
    for group, (start, end) in enumerate(itertools.pairwise(skeleton.qpos_addresses)):
        if end - start == 1:
            half = 0.5 * (values[:, start] - skeleton.joint_refs[group])
            _set_along_axis(joints[:, group], skeleton.joint_axes[group], half.sin())
            joints[:, group, 3] = half.cos()
        else:
            joints[:, group] = rotations.xyzw_from_wxyz(values[:, start:end])
    turns = _compose(skeleton, rotations.xyzw_from_wxyz(values[:, 3:_ROOT]), joints)
    return values[:, :3].numpy(), turns.numpy()


def local_poses(skeleton: Skeleton, qpos: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions (m) and rotations (T, J, 4) xyzw in the parents' frames for qpos (T, nq).

    Positions are (J, 3) if all joints are at the origins of their bodies, and (T, J, 3) otherwise.
    """
    root = int(skeleton.model.jnt_bodyid[0])
    bodies = range(root, root + skeleton.num_bodies)
    positions, turns = body_poses(skeleton.model, qpos, bodies)
    local = local_rotations(skeleton.parent_indices, turns)
    if not skeleton.has_offset_joints:
        return skeleton.local_translation, local
    parents = list(skeleton.parent_indices[1:])
    to_parent = rotations.quat_conjugate(torch.from_numpy(turns[:, parents]))
    offsets = torch.from_numpy(positions[:, 1:] - positions[:, parents])
    moved = np.tile(skeleton.local_translation, (len(positions), 1, 1))
    moved[:, 1:] = rotations.quat_apply(to_parent, offsets).numpy()
    return moved, local


def dofs_of_clip(skeleton: Skeleton, clip: MotionClip) -> FloatArray:
    """Return the DOFs (T, D) rad of a clip whose bodies are in the order of `skeleton`."""
    if clip.dof_pos is None:
        return dofs_from_rotations(skeleton, clip.local_rotation)
    return np.asarray(clip.dof_pos, dtype=np.float64)


def dofs_from_rotations(skeleton: Skeleton, local_rotation: FloatArray) -> FloatArray:
    """Return the DOFs (T, num_dofs) in rad of local rotations (T, J, 4) xyzw.

    Hinge angles are within pi of their rest angles. Raises the errors of `qpos_from_poses`.
    """
    vectors = rotations.quat_log(turned_by_joints(skeleton, local_rotation))
    columns = []
    for group, body in enumerate(skeleton.dof_body_ids):
        own = vectors[:, body]
        columns.append(
            own if skeleton.dof_sizes[group] == 3 else _hinge_angle(skeleton, group, own)
        )
    return torch.cat(columns, dim=-1).numpy()


def rotations_from_dofs(
    skeleton: Skeleton, root_rotation: FloatArray, dofs: FloatArray
) -> FloatArray:
    """Return the local rotations (T, J, 4) xyzw of root rotations (T, 4) and DOFs (T, num_dofs)."""
    root = torch.from_numpy(np.asarray(root_rotation, dtype=np.float64))
    return _compose(skeleton, root, joint_rotations(skeleton, dofs)).numpy()


def joint_rotations(skeleton: Skeleton, dofs: FloatArray) -> Tensor:
    """Return the rotation (T, G, 4) xyzw of each joint at DOFs (T, num_dofs) in rad."""
    values = torch.from_numpy(np.asarray(dofs, dtype=np.float64))
    vectors = torch.zeros((len(values), len(skeleton.dof_body_ids), 3), dtype=torch.float64)
    for group, (start, end) in enumerate(itertools.pairwise(skeleton.dof_offsets)):
        if end - start == 1:
            angle = values[:, start] - skeleton.joint_refs[group]
            _set_along_axis(vectors[:, group], skeleton.joint_axes[group], angle)
        else:
            vectors[:, group] = values[:, start:end]
    return rotations.quat_from_angle_axis(vectors.norm(dim=-1), vectors)


def turned_by_joints(skeleton: Skeleton, local_rotation: FloatArray) -> Tensor:
    """Return the bodies' rotations (T, J, 4) xyzw relative to their rest rotations.

    Raises the errors of `qpos_from_poses`.
    """
    if skeleton.shared_body_ids:
        names = ", ".join(skeleton.body_names[body] for body in skeleton.shared_body_ids)
        raise MotionFileError(
            f"rotations of bodies do not determine the angles of several joints on one body"
            f" ({names}); give a clip with joint coordinates (dof_pos), see clip_from_qpos"
        )
    turns = torch.from_numpy(np.array(local_rotation, dtype=np.float64))
    turned = _turned_at_rest(skeleton)
    from_rest = rotations.quat_conjugate(torch.from_numpy(skeleton.rest_rotation[turned]))
    turns[:, turned] = rotations.quat_mul(from_rest.expand(len(turns), -1, -1), turns[:, turned])
    return turns


def _compose(skeleton: Skeleton, root_rotation: Tensor, joints: Tensor) -> Tensor:
    """Return local rotations (T, J, 4) for rotations of the root (T, 4) and the joints (T, G, 4).

    The joints of a body rotate the body one after another from its rest rotation.
    """
    turns = torch.from_numpy(skeleton.rest_rotation).repeat(len(joints), 1, 1)
    turned = set(_turned_at_rest(skeleton))
    for group, body in enumerate(skeleton.dof_body_ids):
        joint = joints[:, group]
        turns[:, body] = rotations.quat_mul(turns[:, body], joint) if body in turned else joint
        turned.add(body)
    turns[:, 0] = root_rotation
    return turns


def _turned_at_rest(skeleton: Skeleton) -> list[int]:
    """Return the ids of bodies whose rest rotation is not the identity."""
    return np.flatnonzero(np.any(skeleton.rest_rotation[:, :3], axis=1)).tolist()


def _hinge_angle(skeleton: Skeleton, group: int, vectors: Tensor) -> Tensor:
    """Return the angles (T, 1) rad of a hinge for rotation vectors (T, 3) of its body."""
    axis = skeleton.joint_axes[group]
    # The components are not summed, because a sum with zeros would change the signs of zeros.
    parts = [float(axis[i]) * vectors[:, i : i + 1] for i in np.flatnonzero(axis)]
    angle = torch.stack(parts).sum(dim=0) if len(parts) > 1 else parts[0]
    ref = float(skeleton.joint_refs[group])
    return angle + ref if ref else angle


def _set_along_axis(vectors: Tensor, axis: npt.NDArray[np.float64], lengths: Tensor) -> None:
    """Set zero vectors (T, 3 or 4) to the vectors of lengths (T,) along an axis (3,)."""
    for i in np.flatnonzero(axis):
        vectors[:, int(i)] = float(axis[i]) * lengths


def dofs_from_qpos(skeleton: Skeleton, qpos: npt.NDArray[np.float64]) -> FloatArray:
    """Return the DOFs (T, num_dofs) rad for qpos (T, nq)."""
    columns = []
    for start, end in itertools.pairwise(skeleton.qpos_addresses):
        values = torch.from_numpy(qpos[:, start:end])
        if end - start == 4:
            values = rotations.quat_log(rotations.quat_unit(rotations.xyzw_from_wxyz(values)))
        columns.append(values.numpy())
    return np.concatenate(columns or [np.zeros((len(qpos), 0))], axis=1)


def body_poses(
    model: mujoco.MjModel, qpos: FloatArray, bodies: Iterable[str | int]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return world positions (T, B, 3) m and rotations (T, B, 4) xyzw of bodies for qpos (T, nq).

    MuJoCo's kinematics computes the poses. The columns of objects in qpos may be left out.
    """
    ids = [model.body(body).id for body in bodies]
    data = mujoco.MjData(model)
    columns = min(qpos.shape[1], model.nq)
    positions, quats = np.zeros((len(qpos), len(ids), 3)), np.zeros((len(qpos), len(ids), 4))
    for frame, pose in enumerate(qpos):
        data.qpos[:columns] = pose[:columns]
        mujoco.mj_kinematics(model, data)
        positions[frame], quats[frame] = data.xpos[ids], data.xquat[ids]
    return positions, rotations.xyzw_from_wxyz(torch.from_numpy(quats)).numpy()
