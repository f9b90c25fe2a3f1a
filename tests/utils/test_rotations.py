"""Rotations against scipy's, MuJoCo's and the check values of the specification.

float64 unless said: only rounding remains, so 1e-12 is the tolerance where no acos of a number
near 1 is involved.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from isaacgymenvs_lite.utils import rotations as R

ATOL = 1e-12
# Some rotation, normalise(0.1, -0.2, 0.3, 0.9), for which the specification gives results to six
# digits: half a unit of the last one.
Q = R.normalize(torch.tensor([0.1, -0.2, 0.3, 0.9], dtype=torch.float64))
SIX_DIGITS = 5.1e-7
SQRT_HALF = math.sqrt(0.5)


def _vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def _random_quaternions(n: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return R.normalize(torch.randn(n, 4, dtype=torch.float64, generator=generator))


def _random_vectors(n: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, 3, dtype=torch.float64, generator=generator)


def _close(actual: Tensor, expected: Tensor | np.ndarray, atol: float = ATOL) -> None:
    np.testing.assert_allclose(actual.numpy(), np.asarray(expected), rtol=0.0, atol=atol)


def _same_rotation(actual: Tensor, expected: Tensor | np.ndarray, atol: float = ATOL) -> None:
    """Compare quaternions up to their sign."""
    other = torch.as_tensor(np.asarray(expected))
    sign = torch.where((actual * other).sum(-1, keepdim=True) < 0.0, -1.0, 1.0)
    _close(actual * sign, other, atol)


# --- order of the components ----------------------------------------------------------------


def test_orders_of_quaternions() -> None:
    _close(R.xyzw_from_wxyz(_vector(4.0, 1.0, 2.0, 3.0)), _vector(1.0, 2.0, 3.0, 4.0))
    _close(R.wxyz_from_xyzw(_vector(1.0, 2.0, 3.0, 4.0)), _vector(4.0, 1.0, 2.0, 3.0))


# --- products and rotated vectors -------------------------------------------------------------


def test_products_are_those_of_scipy() -> None:
    a, b = _random_quaternions(50, 0), _random_quaternions(50, 1)
    expected = (Rotation.from_quat(a.numpy()) * Rotation.from_quat(b.numpy())).as_quat()
    _same_rotation(R.quat_mul(a, b), expected)


def test_rotated_vectors_of_the_specification() -> None:
    v = _vector(1.0, 2.0, 3.0)
    forth, back = _vector(-1.442105, 1.157895, 3.252632), _vector(3.105263, 1.157895, 1.736842)
    _close(R.quat_rotate(Q, v), forth, SIX_DIGITS)
    _close(R.quat_apply(Q, v), forth, SIX_DIGITS)
    _close(R.quat_rotate_inverse(Q, v), back, SIX_DIGITS)


def test_rotated_vectors_are_those_of_scipy() -> None:
    q, v = _random_quaternions(50, 0), _random_vectors(50, 1)
    turn = Rotation.from_quat(q.numpy())
    _close(R.quat_rotate(q, v), turn.apply(v.numpy()))
    _close(R.quat_apply(q, v), turn.apply(v.numpy()))
    _close(R.quat_rotate_inverse(q, v), turn.inv().apply(v.numpy()))


# --- lengths and angles ---------------------------------------------------------------------


def test_normalize_leaves_zero_alone() -> None:
    _close(R.normalize(_vector(3.0, 0.0, 4.0)), _vector(0.6, 0.0, 0.8))
    _close(R.normalize(_vector(0.0, 0.0, 0.0)), _vector(0.0, 0.0, 0.0))
    # shorter than eps = 1e-9: divided by eps
    _close(R.normalize(_vector(2e-10, 0.0, 0.0)), _vector(0.2, 0.0, 0.0))


def test_normalize_angle() -> None:
    for angle, expected in [
        (0.5, 0.5),
        (-3.5, 2.0 * math.pi - 3.5),
        (7.0, 7.0 - 2.0 * math.pi),
        (-13.0, 4 * math.pi - 13),
    ]:
        _close(R.normalize_angle(_vector(angle)), _vector(expected))


def test_quat_from_angle_axis_takes_axes_of_any_length() -> None:
    q = R.quat_from_angle_axis(_vector(math.pi / 2.0), _vector(0.0, 0.0, 7.0).unsqueeze(0))
    _close(q, _vector(0.0, 0.0, SQRT_HALF, SQRT_HALF).unsqueeze(0))


def test_angle_and_axis_undo_each_other() -> None:
    q = _random_quaternions(50, 0)
    angle, axis = R.quat_to_angle_axis(q)
    assert angle.abs().max() <= math.pi
    _close(axis.norm(dim=-1), np.ones(50))
    _same_rotation(R.quat_from_angle_axis(angle, axis), q)


def test_quat_diff_rad_by_hand_and_as_scipy() -> None:
    tenth = _vector(0.0, math.sin(0.05), 0.0, math.cos(0.05))
    _close(R.quat_diff_rad(tenth, _vector(0.0, 0.0, 0.0, 1.0)), _vector(0.1)[0])
    a, b = _random_quaternions(50, 0), _random_quaternions(50, 1)
    turn = Rotation.from_quat(a.numpy()) * Rotation.from_quat(b.numpy()).inv()
    # asin of a number near 1 loses half of the digits
    _close(R.quat_diff_rad(a, b), turn.magnitude(), atol=1e-7)


# --- rotation vectors -------------------------------------------------------------------------


def test_rotation_vectors_up_to_pi_are_those_of_scipy() -> None:
    v = _random_vectors(100, 0)
    v = v[v.norm(dim=-1) < math.pi - 1e-3]
    turn = Rotation.from_rotvec(v.numpy())
    for keep_long in (False, True):
        _same_rotation(R.exp_map_to_quat(v, keep_long), turn.as_quat())
    q = R.exp_map_to_quat(v)
    # acos near w = 1 loses half of the digits; quat_log does not.
    _close(R.quat_to_exp_map(q), v, atol=1e-7)
    _close(R.quat_log(q), v)


def test_vectors_between_one_and_two_pi_mean_nothing_by_the_first_rule() -> None:
    v = torch.stack((_vector(4.0, 0.0, 0.0), _vector(0.0, -3.0, 4.0)))  # 4 and 5 rad long
    _close(R.exp_map_to_quat(v), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    angle, axis = R.exp_map_to_angle_axis(v)
    _close(angle, np.zeros(2))
    _close(axis, np.tile([0.0, 0.0, 1.0], (2, 1)))


def test_vectors_between_one_and_two_pi_keep_their_rotation_by_the_second_rule() -> None:
    v = torch.stack((_vector(4.0, 0.0, 0.0), _vector(0.0, -3.0, 4.0)))
    _same_rotation(
        R.exp_map_to_quat(v, keep_long=True),
        torch.stack(
            (
                _vector(math.sin(2.0), 0.0, 0.0, math.cos(2.0)),
                _vector(0.0, -0.6 * math.sin(2.5), 0.8 * math.sin(2.5), math.cos(2.5)),
            )
        ),
    )
    angle, axis = R.exp_map_to_angle_axis(v, keep_long=True)
    _close(angle, _vector(4.0 - 2.0 * math.pi, 5.0 - 2.0 * math.pi))
    _close(axis, torch.stack((_vector(1.0, 0.0, 0.0), _vector(0.0, -0.6, 0.8))))


def test_quat_log_is_mujoco_s() -> None:
    q = torch.cat(
        (
            _random_quaternions(100, 0),
            torch.stack(
                (
                    _vector(0.0, 0.0, 0.0, 1.0),
                    _vector(0.0, 0.0, 0.0, -1.0),
                    _vector(1e-12, -2e-12, 0.0, 1.0),
                    _vector(0.0, 1e-6, 0.0, -1.0),
                    _vector(0.0, 0.0, 1.0, 0.0),
                    R.normalize(_vector(0.6, 0.0, 0.8, -1e-9)),
                )
            ),
        )
    )
    expected = np.zeros((len(q), 3))
    for row, wxyz in zip(expected, R.wxyz_from_xyzw(q).numpy(), strict=True):
        mujoco.mju_quat2Vel(row, wxyz.copy(), 1.0)
    _close(R.quat_log(q), expected)
    assert R.quat_log(q).norm(dim=-1).max() <= math.pi + ATOL


# --- encodings and heading ------------------------------------------------------------------


def test_tan_norm_of_the_specification() -> None:
    expected = _vector(0.726316, 0.526316, 0.442105, -0.315789, -0.315789, 0.894737)
    _close(R.quat_to_tan_norm(Q), expected, SIX_DIGITS)
    from_vector = R.quat_to_tan_norm(R.exp_map_to_quat(_vector(0.3, -0.2, 0.5)))
    expected = _vector(0.859534, 0.439868, 0.260227, -0.114917, -0.329794, 0.937032)
    _close(from_vector, expected, SIX_DIGITS)
    # A hinge of -0.7 rad about y in ASE's form.
    hinge = R.quat_to_tan_norm(R.exp_map_to_quat(_vector(0.0, -0.7, 0.0)))
    _close(hinge, _vector(0.764842, 0.0, 0.644218, -0.644218, 0.0, 0.764842), SIX_DIGITS)


def test_heading_of_the_specification() -> None:
    _close(R.calc_heading(Q), torch.tensor(0.627071), SIX_DIGITS)
    inverse = R.calc_heading_quat_inv(Q)
    without = R.quat_to_tan_norm(R.quat_mul(inverse, Q))
    expected = _vector(0.896963, 0.0, 0.442105, -0.441008, -0.070413, 0.894737)
    _close(without, expected, SIX_DIGITS)
    v = R.quat_rotate(inverse, _vector(1.0, 0.2, 0.1))
    _close(v, _vector(0.927105, -0.424825, 0.1), SIX_DIGITS)


# --- interpolation ----------------------------------------------------------------------------


def test_slerp_takes_the_shorter_way() -> None:
    identity = _vector(0.0, 0.0, 0.0, 1.0)
    quarter = -_vector(0.0, 0.0, SQRT_HALF, SQRT_HALF)
    half = math.pi / 8.0
    expected = _vector(0.0, 0.0, math.sin(half), math.cos(half))
    _close(R.slerp(identity, quarter, _vector(0.5)), expected)


def test_slerp_between_is_that_of_scipy() -> None:
    a, b = _random_quaternions(30, 0), _random_quaternions(30, 1)
    t = torch.rand(30, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    first, second = Rotation.from_quat(a.numpy()), Rotation.from_quat(b.numpy())
    step = Rotation.from_rotvec(t.numpy() * (second * first.inv()).as_rotvec())
    # acos of the cosine, which may be near 1
    _same_rotation(R.slerp(a, b, t), (step * first).as_quat(), atol=1e-7)


def test_slerp_of_nearly_equal_rotations_is_their_mean_at_any_time() -> None:
    for t in [0.0, 0.3, 1.0]:
        a = _vector(0.0, 0.0, 0.0, 1.0)
        # sine of the angle between the quaternions 0.0009, below the threshold of 0.001
        b = _vector(0.0009, 0.0, 0.0, math.sqrt(1.0 - 0.0009**2))
        _close(R.slerp(a, b, _vector(t)), 0.5 * (a + b))
        _close(R.slerp(a, -b, _vector(t)), 0.5 * (a + b))
        # just above it the time counts
        b = _vector(0.0011, 0.0, 0.0, math.sqrt(1.0 - 0.0011**2))
        assert abs(float(R.slerp(a, b, _vector(0.1))[0]) - 0.00011) < 1e-8


# --- Euler angles -----------------------------------------------------------------------------


def test_euler_angles_of_the_specification() -> None:
    angles = torch.stack(R.get_euler_xyz(Q))
    _close(angles, _vector(0.070471, 5.825241, 0.627071), SIX_DIGITS)


def test_euler_angles_are_those_of_scipy() -> None:
    q = _random_quaternions(50, 0)
    expected = Rotation.from_quat(q.numpy()).as_euler("xyz") % (2.0 * math.pi)
    angles = torch.stack(R.get_euler_xyz(q), dim=-1)
    # asin near 1 loses digits
    _close(angles, expected, atol=1e-7)
    _same_rotation(R.quat_from_euler_xyz(*angles.unbind(-1)), q, atol=1e-7)
