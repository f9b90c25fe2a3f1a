"""The names of IsaacGymEnvs' `utils.torch_jit_utils`, and of `isaacgym.torch_utils`.

Quaternions are xyzw, except in `quaternion_to_matrix` and `matrix_to_quaternion`, whose real part
comes first. The functions for rotations come from `utils.rotations`; no function is compiled.
"""

# ruff: noqa: F401  imported names that this module does not use are part of the interface

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.utils.rotations import (
    angle_axis_to_exp_map,
    calc_heading,
    calc_heading_quat,
    calc_heading_quat_inv,
    euler_xyz_to_exp_map,
    exp_map_to_angle_axis,
    exp_map_to_quat,
    get_euler_xyz,
    matrix_to_quat,
    normalize,
    normalize_angle,
    quat_apply,
    quat_conjugate,
    quat_diff_rad,
    quat_from_angle_axis,
    quat_from_euler_xyz,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_angle_axis,
    quat_to_exp_map,
    quat_to_matrix,
    quat_to_tan_norm,
    quat_unit,
    slerp,
    wxyz_from_xyzw,
    xyzw_from_wxyz,
)
from isaacgymenvs_lite.utils.scaling import scale, unscale

_Array = TypeVar("_Array", Tensor, npt.NDArray[np.floating])

my_quat_rotate = quat_rotate
get_basis_vector = quat_rotate
scale_transform = unscale
unscale_transform = scale
tf_vector = quat_apply


def unscale_np(x: _Array, lower: _Array, upper: _Array) -> _Array:
    """Map numpy values (..., D) from [lower (D,), upper (D,)] to [-1, 1]."""
    return (2.0 * x - upper - lower) / (upper - lower)


def tf_inverse(q: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverses of transforms that rotate by q (..., 4), then translate by t (..., 3)."""
    q_inv = quat_conjugate(q)
    return q_inv, -quat_apply(q_inv, t)


def tf_apply(q: Tensor, t: Tensor, v: Tensor) -> Tensor:
    """Return points v (..., 3), rotated by q (..., 4) and then translated by t (..., 3)."""
    return quat_apply(q, v) + t


def tf_combine(q1: Tensor, t1: Tensor, q2: Tensor, t2: Tensor) -> tuple[Tensor, Tensor]:
    """Return q (..., 4) and t (..., 3) of the transforms that apply 2 first and then 1."""
    return quat_mul(q1, q2), tf_apply(q1, t1, t2)


def local_to_world_space(pos_offset_local: Tensor, pose_global: Tensor) -> Tensor:
    """Map points (n, 3) m from the frames of poses (n, 7) to the world frame.

    A pose consists of a position and a rotation xyzw.
    """
    return tf_apply(pose_global[:, 3:7], pose_global[:, :3], pos_offset_local)


def normalise_quat_in_pose(pose: Tensor) -> Tensor:
    """Return poses (n, 7) with rotations of unit length, without changing the argument."""
    return torch.cat((pose[:, :3], quat_unit(pose[:, 3:7])), dim=-1)


def quaternion_to_matrix(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4), real part first."""
    return quat_to_matrix(xyzw_from_wxyz(quaternions))


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Return the quaternions (..., 4), real part first, of rotation matrices (..., 3, 3)."""
    return wxyz_from_xyzw(matrix_to_quat(matrix))


def to_torch(
    x: object,
    dtype: torch.dtype = torch.float,
    device: str | torch.device = "cpu",
    requires_grad: bool = False,
) -> Tensor:
    """Return numbers as a tensor; unlike here, IsaacGymEnvs' default device is cuda:0."""
    return torch.tensor(x, dtype=dtype, device=device, requires_grad=requires_grad)


def get_axis_params(
    value: float, axis_idx: int, x_value: float = 0.0, dtype: type = float, n_dims: int = 3
) -> list[float]:
    """Return zeros with `value` at `axis_idx`, and `x_value` at index 0 unless `axis_idx` is 0."""
    params = [0.0] * n_dims
    params[0] = x_value
    params[axis_idx] = value
    return [dtype(entry) for entry in params]


def torch_rand_float(
    lower: float, upper: float, shape: tuple[int, int], device: str | torch.device
) -> Tensor:
    """Return a tensor of uniform random values in [lower, upper)."""
    return (upper - lower) * torch.rand(*shape, device=device) + lower


def torch_random_dir_2(shape: tuple[int, int], device: str | torch.device) -> Tensor:
    """Return random unit vectors (n, 2); `shape` must be (n, 1)."""
    angle = torch_rand_float(-torch.pi, torch.pi, shape, device).squeeze(-1)
    return torch.stack((torch.cos(angle), torch.sin(angle)), dim=-1)


def tensor_clamp(t: Tensor, min_t: Tensor, max_t: Tensor) -> Tensor:
    """Return t, clamped between the tensors `min_t` and `max_t`."""
    return t.clamp(min_t, max_t)


saturate = tensor_clamp


def copysign(a: float, b: Tensor) -> Tensor:
    """Return |a| with the signs of b (n,); the result is 0 where b is 0."""
    return abs(a) * torch.sign(b)


def quat_axis(q: Tensor, axis: int = 0) -> Tensor:
    """Return the unit vectors (n, 3) that rotations (n, 4) make of a coordinate axis."""
    basis = torch.zeros(len(q), 3, device=q.device, dtype=q.dtype)
    basis[:, axis] = 1.0
    return quat_rotate(q, basis)


def compute_heading_and_up(
    torso_rotation: Tensor,
    inv_start_rot: Tensor,
    to_target: Tensor,
    vec0: Tensor,
    vec1: Tensor,
    up_idx: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the orientations of n torsos and their headings relative to targets.

    Args:
        torso_rotation: (n, 4) rotations in the world.
        inv_start_rot: (n, 4) inverses of the initial rotations.
        to_target: (n, 3) m, vectors to the targets.
        vec0: (n, 3) forward axis in the torso's frame.
        vec1: (n, 3) up axis in the torso's frame.
        up_idx: index of the world's vertical axis.

    Returns:
        rotations since the start (n, 4), vertical components of `vec1` (n,), components of `vec0`
        towards the target (n,), and `vec1` (n, 3) and `vec0` (n, 3) in the world frame.
    """
    torso_quat = quat_mul(torso_rotation, inv_start_rot)
    up, heading = quat_rotate(torso_quat, vec1), quat_rotate(torso_quat, vec0)
    heading_proj = (heading * normalize(to_target)).sum(-1)
    return torso_quat, up[:, up_idx], heading_proj, up, heading


def compute_rot(
    torso_quat: Tensor, velocity: Tensor, ang_velocity: Tensor, targets: Tensor, positions: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return velocities in the frames of n torsos, the torsos' Euler angles, and target angles.

    All arguments are in the world frame: rotations (n, 4), velocities (n, 3) in m/s and rad/s, and
    positions (n, 3) in m.

    Returns:
        linear and angular velocities (n, 3) in the torsos' frames, roll, pitch, yaw (n,) in
        [0, 2 pi), and the angles to the targets (n,), which use the third coordinate as
        IsaacGymEnvs does.
    """
    roll, pitch, yaw = get_euler_xyz(torso_quat)
    away = targets - positions
    angle = torch.atan2(away[:, 2], away[:, 0]) - yaw
    local = quat_rotate_inverse(torso_quat, velocity)
    return local, quat_rotate_inverse(torso_quat, ang_velocity), roll, pitch, yaw, angle
