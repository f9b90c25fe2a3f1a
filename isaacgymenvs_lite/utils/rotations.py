"""Rotations as quaternions (x, y, z, w) and rotation vectors, batched over leading dimensions.

Names and conventions follow IsaacGymEnvs' `torch_jit_utils` and the AMP code. Quaternions have unit
length unless a function says otherwise; angles are in rad. Functions accept float32 or float64
tensors and return the same dtype. This module also converts between Isaac's order (x, y, z, w) and
MuJoCo's order (w, x, y, z).

Functions named `..._components` take and return one tensor or numpy array per component. These
functions are several times as fast for callers that store each component in separate memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy.typing as npt
import torch
from torch import Tensor

# A tensor or array with one component of all quaternions or vectors.
_Array = TypeVar("_Array", Tensor, npt.NDArray[Any])

# A rotation vector with a smaller angle (rad) counts as the identity.
_SMALL_ANGLE_RAD = 1e-5


def xyzw_from_wxyz(q: Tensor) -> Tensor:
    """Reorder MuJoCo quaternions (..., 4) wxyz to Isaac's xyzw."""
    return q.roll(-1, dims=-1)


def wxyz_from_xyzw(q: Tensor) -> Tensor:
    """Reorder Isaac quaternions (..., 4) xyzw to MuJoCo's wxyz."""
    return q.roll(1, dims=-1)


def normalize(x: Tensor, eps: float = 1e-9) -> Tensor:
    """Scale vectors (..., d) to unit length; divide vectors shorter than `eps` by `eps`."""
    return x / x.norm(dim=-1, keepdim=True).clamp(min=eps)


def length(x: Tensor) -> Tensor:
    """Return the lengths (...) of vectors (..., d).

    For small d this is several times as fast as `Tensor.norm`.
    """
    return x.square().sum(-1).sqrt()


def quat_unit(q: Tensor) -> Tensor:
    """Scale quaternions (..., 4) to unit length."""
    return normalize(q)


def quat_conjugate(q: Tensor) -> Tensor:
    """Return the inverse rotations of unit quaternions (..., 4)."""
    return torch.cat((-q[..., :3], q[..., 3:]), dim=-1)


def quat_mul(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton products a * b, (..., 4): the rotation b followed by a."""
    return torch.stack(quat_mul_components(a.unbind(-1), b.unbind(-1)), dim=-1)


def quat_mul_components(a: Iterable[_Array], b: Iterable[_Array]) -> tuple[_Array, ...]:
    """Return the four components of `quat_mul` from the components of a and b."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross products of vectors (..., 3), with broadcasting."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def cross_components(a: Iterable[_Array], b: Iterable[_Array]) -> tuple[_Array, ...]:
    """Return the three components of `cross` from the components of a and b."""
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors v (..., 3) by quaternions q (..., 4)."""
    return _rotate(q[..., :3], q[..., 3:], v)


def quat_rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors v (..., 3) by the inverses of quaternions q (..., 4)."""
    return _rotate(-q[..., :3], q[..., 3:], v)


def _rotate(u: Tensor, w: Tensor, v: Tensor) -> Tensor:
    """Rotate by v (2 w^2 - 1) + 2 w (u x v) + 2 u (u . v), as in IsaacGymEnvs."""
    along = (u * v).sum(dim=-1, keepdim=True)
    return v * (2.0 * w * w - 1.0) + 2.0 * w * cross(u, v) + 2.0 * u * along


def quat_apply(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors v (..., 3) by quaternions q (..., 4): v + w t + u x t with t = 2 u x v."""
    return torch.stack(rotate_components(q.unbind(-1), v.unbind(-1)), dim=-1)


def rotate_components(q: Iterable[_Array], v: Iterable[_Array]) -> tuple[_Array, ...]:
    """Return the three components of `quat_apply` from the components of q and v."""
    x, y, z, w = q
    vx, vy, vz = v
    tx, ty, tz = cross_components((x, y, z), (vx, vy, vz))
    tx, ty, tz = tx + tx, ty + ty, tz + tz
    ux, uy, uz = cross_components((x, y, z), (tx, ty, tz))
    return vx + w * tx + ux, vy + w * ty + uy, vz + w * tz + uz


def normalize_angle(angle: Tensor) -> Tensor:
    """Wrap angles (rad) into [-pi, pi]."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))


def quat_from_angle_axis(angle: Tensor, axis: Tensor) -> Tensor:
    """Return the rotations (..., 4) by `angle` (...) rad about `axis` (..., 3) of any length."""
    half = (angle / 2.0).unsqueeze(-1)
    return quat_unit(torch.cat((normalize(axis) * half.sin(), half.cos().expand_as(half)), dim=-1))


def quat_to_angle_axis(q: Tensor) -> tuple[Tensor, Tensor]:
    """Return angle (...) in (-pi, pi] and unit axis (..., 3) of quaternions (..., 4).

    Rotations with sqrt(1 - w^2) <= 1e-5 give angle 0 and axis (0, 0, 1), as in IsaacGymEnvs.
    """
    w = q[..., 3].clamp(-1.0, 1.0)
    sin_half = torch.sqrt((1.0 - w * w).clamp(min=0.0))
    turns = sin_half > _SMALL_ANGLE_RAD
    angle = torch.where(turns, normalize_angle(2.0 * torch.acos(w)), torch.zeros_like(w))
    axis = q[..., :3] / torch.where(turns, sin_half, torch.ones_like(w)).unsqueeze(-1)
    up = torch.zeros_like(axis)
    up[..., 2] = 1.0
    return angle, torch.where(turns.unsqueeze(-1), axis, up)


def quat_to_exp_map(q: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of quaternions (..., 4), at most pi long.

    A rotation vector is the angle times the axis that `quat_to_angle_axis` returns.
    """
    w = q[..., 3:].clamp(-1.0, 1.0)
    sin_half = torch.sqrt((1.0 - w * w).clamp(min=0.0))
    scale = normalize_angle(2.0 * torch.acos(w)) / sin_half
    return q[..., :3] * scale.masked_fill(sin_half <= _SMALL_ANGLE_RAD, 0.0)


def angle_axis_to_exp_map(angle: Tensor, axis: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of angles (...) rad about unit axes (..., 3)."""
    return angle.unsqueeze(-1) * axis


def quat_log(q: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of quaternions (..., 4), exact even for small rotations.

    Unlike `quat_to_exp_map`, this function has no threshold and no acos. MuJoCo computes the length
    of an actuator on a ball joint in the same way (`mju_quat2Vel`).
    """
    x, y, z, w = q.unbind(-1)
    # The clamp makes angle / sin_half finite at the identity, where its limit is 2.
    sin_half = torch.sqrt(x * x + y * y + z * z).clamp(min=1e-8)
    # Because the sign of w is in the numerator of atan2, the angle of the rotation is at most pi.
    angle = 2.0 * torch.atan2(torch.copysign(sin_half, w), w.abs())
    return q[..., :3] * (angle / sin_half).unsqueeze(-1)


def exp_map_to_angle_axis(exp_map: Tensor, keep_long: bool = False) -> tuple[Tensor, Tensor]:
    """Return angle (...) in [-pi, pi] and axis (..., 3) of rotation vectors (..., 3).

    The length is wrapped into (-pi, pi]. A wrapped angle of at most 1e-5 gives the angle 0 and the
    axis (0, 0, 1). By default this function compares the signed angle with 1e-5, as IsaacGymEnvs
    does, so that a vector between pi and 2 pi long also gives the angle 0. With `keep_long` this
    function compares the magnitude, as ASE does, so that such a vector keeps its rotation. Both
    rules give the same result for vectors of at most pi, and this project's functions compute only
    such vectors from quaternions.
    """
    length = exp_map.norm(dim=-1)
    angle = normalize_angle(length)
    turns = (angle.abs() if keep_long else angle) > _SMALL_ANGLE_RAD
    axis = exp_map / torch.where(turns, length, torch.ones_like(length)).unsqueeze(-1)
    up = torch.zeros_like(axis)
    up[..., 2] = 1.0
    angle = torch.where(turns, angle, torch.zeros_like(angle))
    return angle, torch.where(turns.unsqueeze(-1), axis, up)


def exp_map_to_quat(exp_map: Tensor, keep_long: bool = False) -> Tensor:
    """Return the quaternions (..., 4) of rotation vectors (..., 3); see `exp_map_to_angle_axis`."""
    return torch.stack(exp_map_to_quat_components(exp_map.unbind(-1), keep_long), dim=-1)


def exp_map_to_quat_components(
    exp_map: Iterable[Tensor], keep_long: bool = False
) -> tuple[Tensor, ...]:
    """Return the four components of `exp_map_to_quat` from the rotation vectors' components."""
    x, y, z = exp_map
    length = torch.sqrt(x * x + y * y + z * z)
    angle = length - 2.0 * math.pi * torch.round(length / (2.0 * math.pi))
    if keep_long:
        angle = angle.masked_fill(angle.abs() <= _SMALL_ANGLE_RAD, 0.0)
    else:
        angle = torch.threshold(angle, _SMALL_ANGLE_RAD, 0.0)
    half = 0.5 * angle
    # The bound has no effect on rotations, because the sine is zero below it.
    axis_scale = half.sin() / length.clamp(min=_SMALL_ANGLE_RAD)
    return x * axis_scale, y * axis_scale, z * axis_scale, half.cos()


def quat_to_tan_norm(q: Tensor) -> Tensor:
    """Return the rotated x axis and z axis, (..., 6), for quaternions (..., 4).

    AMP observations encode rotations by this tangent and normal.
    """
    return torch.stack(tan_norm_components(q.unbind(-1)), dim=-1)


def tan_norm_components(q: Iterable[_Array]) -> tuple[_Array, ...]:
    """Return the six components of `quat_to_tan_norm` from the components of q."""
    x, y, z, w = q
    x2, z2, w2 = x + x, z + z, w + w
    scale = w2 * w - 1.0
    xz, wy = x2 * z, w2 * y
    return (
        scale + x2 * x,
        x2 * y + w2 * z,
        xz - wy,
        xz + wy,
        z2 * y - w2 * x,
        scale + z2 * z,
    )


def calc_heading(q: Tensor) -> Tensor:
    """Return the heading (...) of rotations (..., 4), the angle of the rotated x axis about z."""
    x, y, z, w = q.unbind(-1)
    return torch.atan2(2.0 * (x * y + w * z), 2.0 * (w * w + x * x) - 1.0)


def calc_heading_quat(q: Tensor) -> Tensor:
    """Return the rotations about z by the heading of q, (..., 4)."""
    return _about_z(calc_heading(q))


def calc_heading_quat_inv(q: Tensor) -> Tensor:
    """Return the rotations about z by minus the heading of q, (..., 4)."""
    return _about_z(-calc_heading(q))


def _about_z(angle: Tensor) -> Tensor:
    half = angle * 0.5
    zero = torch.zeros_like(half)
    return torch.stack((zero, zero, half.sin(), half.cos()), dim=-1)


def planar_motion(root_states: Tensor) -> Tensor:
    """Return (n, 3): forward velocity (m/s), velocity to the left (m/s), turn rate (rad/s).

    The velocities are in the heading frame. `root_states` (n, 13) are position, rotation xyzw and
    both velocities, in world axes.
    """
    heading = calc_heading(root_states[:, 3:7])
    velocity = rotate_about_z(heading.cos(), -heading.sin(), root_states[:, 7:10])
    return torch.cat((velocity[:, :2], root_states[:, 12:13]), dim=-1)


def planar_speed(motion: Tensor) -> Tensor:
    """Return the lengths (n,) m/s of `planar_motion` (n, 3); 100 degrees/s count as 1 m/s."""
    turn_m_s = torch.rad2deg(motion[:, 2:]) / 100.0
    return torch.linalg.vector_norm(torch.cat((motion[:, :2], turn_m_s), dim=-1), dim=-1)


def rotate_about_z(cos: Tensor, sin: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors v (..., 3) about world z by an angle given as its cosine and sine (...).

    The result equals that of `quat_rotate` with a heading quaternion and needs a quarter of the
    arithmetic.
    """
    x, y, z = v.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y, z.expand_as(x)), dim=-1)


def slerp(a: Tensor, b: Tensor, t: Tensor) -> Tensor:
    """Interpolate from a to b (..., 4) at t (..., 1) the shorter way, as AMP's motion library does.

    Nearly equal rotations (sine of the angle below 0.001) give the mean (a + b) / 2 for any t. A
    value of t outside [0, 1] extrapolates. AMP's motion library has both rules.
    """
    # AMP's motion library adds the products of components in the order w, x, y, z. For nearly equal
    # rotations the order matters, because the last bit of the sum decides which rule applies.
    products = a * b
    cos = products[..., 3:] + products[..., 0:1] + products[..., 1:2] + products[..., 2:3]
    sign = torch.ones_like(cos).masked_fill(cos < 0.0, -1.0)
    cos = cos.abs()
    angle = torch.acos(cos.clamp(max=1.0))
    sin = torch.sqrt((1.0 - cos * cos).clamp(min=0.0))
    near = sin < 0.001
    same = cos >= 1.0
    from_a = (torch.sin((1.0 - t) * angle) / sin).masked_fill(near, 0.5).masked_fill(same, 1.0)
    from_b = (torch.sin(t * angle) / sin).masked_fill(near, 0.5).masked_fill(same, 0.0)
    return from_a * a + from_b * sign * b


def get_euler_xyz(q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return roll, pitch, yaw (...) of quaternions (..., 4), each in [0, 2 pi)."""
    x, y, z, w = q.unbind(-1)
    roll = torch.atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    sin_pitch = 2.0 * (w * y - z * x)
    pitch = torch.where(
        sin_pitch.abs() >= 1.0,
        torch.copysign(torch.full_like(sin_pitch, math.pi / 2.0), sin_pitch),
        torch.asin(sin_pitch.clamp(-1.0, 1.0)),
    )
    yaw = torch.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    turn = 2.0 * math.pi
    return roll % turn, pitch % turn, yaw % turn


def quat_from_euler_xyz(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """Return the quaternions (..., 4) of the rotations Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = (roll * 0.5).cos(), (roll * 0.5).sin()
    cp, sp = (pitch * 0.5).cos(), (pitch * 0.5).sin()
    cy, sy = (yaw * 0.5).cos(), (yaw * 0.5).sin()
    return torch.stack(
        (
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
            cy * cp * cr + sy * sp * sr,
        ),
        dim=-1,
    )


def quat_diff_rad(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle (...) in rad between rotations a and b (..., 4)."""
    difference = quat_mul(a, quat_conjugate(b))
    return 2.0 * torch.asin(length(difference[..., :3]).clamp(max=1.0))


def euler_xyz_to_exp_map(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of the rotations Rz(yaw) Ry(pitch) Rx(roll)."""
    return quat_to_exp_map(quat_from_euler_xyz(roll, pitch, yaw))


def quat_to_matrix(q: Tensor) -> Tensor:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) of any length but zero.

    Column i is the rotated axis i.
    """
    x, y, z, w = q.unbind(-1)
    # Products of two components are divided by the squared length.
    x2, y2, z2 = (2.0 * part / (q * q).sum(-1) for part in (x, y, z))
    rows = (
        (1.0 - y * y2 - z * z2, x * y2 - w * z2, x * z2 + w * y2),
        (x * y2 + w * z2, 1.0 - x * x2 - z * z2, y * z2 - w * x2),
        (x * z2 - w * y2, y * z2 + w * x2, 1.0 - x * x2 - y * y2),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def matrix_to_quat(matrix: Tensor) -> Tensor:
    """Return the quaternions (..., 4) of rotation matrices (..., 3, 3).

    The largest component of the result is positive. It is computed from the diagonal, and the
    divisor of all other components is this largest component (Shepperd 1978), so that the divisor
    is never small.

    Raises:
        ValueError: the last two dimensions are not 3 and 3.
    """
    if matrix.shape[-2:] != (3, 3):
        raise ValueError(
            f"rotation matrices: got shape {tuple(matrix.shape)}, expected (..., 3, 3)"
        )
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in matrix.unbind(-2))
    # The rows of 4 q q^T are multiples of q; the row with the largest diagonal entry is used.
    products = (
        (1.0 + xx - yy - zz, xy + yx, xz + zx, zy - yz),
        (xy + yx, 1.0 - xx + yy - zz, yz + zy, xz - zx),
        (xz + zx, yz + zy, 1.0 - xx - yy + zz, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1.0 + xx + yy + zz),
    )
    table = torch.stack([torch.stack(row, dim=-1) for row in products], dim=-2)
    largest = table.diagonal(dim1=-2, dim2=-1).argmax(-1)
    places = largest[..., None, None].expand(*largest.shape, 1, 4)
    return quat_unit(table.gather(-2, places).squeeze(-2))
