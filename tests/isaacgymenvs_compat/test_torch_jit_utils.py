"""Helpers of tensors under IsaacGymEnvs' names: by hand, and against scipy."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.isaacgymenvs_compat import torch_jit_utils as published

LOWER, UPPER = torch.tensor([-1.0, 0.0]), torch.tensor([3.0, 10.0])


def test_shares_of_ranges_and_back() -> None:
    values = torch.tensor([[-1.0, 10.0], [1.0, 2.5]])
    shares = torch.tensor([[-1.0, 1.0], [0.0, -0.5]])
    torch.testing.assert_close(published.unscale(values, LOWER, UPPER), shares)
    torch.testing.assert_close(published.scale(shares, LOWER, UPPER), values)
    torch.testing.assert_close(published.scale_transform(values, LOWER, UPPER), shares)
    torch.testing.assert_close(published.unscale_transform(shares, LOWER, UPPER), values)
    outside = torch.tensor([[-5.0, 11.0]])
    assert published.tensor_clamp(outside, LOWER, UPPER).tolist() == [[-1.0, 10.0]]


def test_axes_of_a_rotation_are_the_columns_of_its_matrix() -> None:
    rotations = Rotation.random(5, random_state=1)
    q = torch.from_numpy(rotations.as_quat())
    for axis in range(3):
        expected = torch.from_numpy(rotations.as_matrix()[:, :, axis])
        torch.testing.assert_close(published.quat_axis(q, axis), expected)


def test_where_a_torso_faces_and_how_it_moves() -> None:
    # Turned by 90 degrees about z, it faces +y; the target is at 45 degrees.
    q = torch.tensor([[0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]])
    start = torch.tensor([[0.0, 0.0, 0.0, 1.0]])
    x, z = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    to_target = torch.tensor([[3.0, 3.0, 0.0]])
    turned, up_proj, heading_proj, up, heading = published.compute_heading_and_up(
        q, start, to_target, x, z, 2
    )
    torch.testing.assert_close(turned, q)
    assert up_proj.item() == pytest.approx(1.0)
    assert heading_proj.item() == pytest.approx(math.sqrt(0.5))
    torch.testing.assert_close(up, z)
    torch.testing.assert_close(heading, torch.tensor([[0.0, 1.0, 0.0]]))
    local, turning, roll, pitch, yaw, angle = published.compute_rot(
        q, torch.tensor([[0.0, 2.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.5]]), to_target, 0 * x
    )
    torch.testing.assert_close(local, torch.tensor([[2.0, 0.0, 0.0]]))
    torch.testing.assert_close(turning, torch.tensor([[0.0, -1.0, 0.5]]))
    assert (roll.item(), pitch.item()) == (0.0, 0.0)
    assert yaw.item() == pytest.approx(math.pi / 2)
    # The quirk: the angle of (3, z = 0), not of (3, y = 3).
    assert angle.item() == pytest.approx(-math.pi / 2)


def _quats_and_matrices(seed: int, n: int = 200) -> tuple[torch.Tensor, torch.Tensor]:
    rotations = Rotation.random(n, random_state=seed)
    return torch.from_numpy(rotations.as_quat()), torch.from_numpy(rotations.as_matrix())


def test_matrices_of_quaternions_with_the_real_part_first_and_back() -> None:
    q, matrices = _quats_and_matrices(2)
    real_first = torch.cat((q[:, 3:], q[:, :3]), dim=-1)
    torch.testing.assert_close(published.quaternion_to_matrix(real_first), matrices)
    # Of any length.
    torch.testing.assert_close(published.quaternion_to_matrix(3.0 * real_first), matrices)
    back = published.matrix_to_quaternion(matrices.view(2, 100, 3, 3)).view(200, 4)
    largest = back.abs().argmax(-1, keepdim=True)
    assert set(largest.flatten().tolist()) == {0, 1, 2, 3}
    assert (back.gather(-1, largest) > 0).all()
    sign = (back * real_first).sum(-1, keepdim=True).sign()
    torch.testing.assert_close(back, sign * real_first)


def test_transforms_are_those_of_homogeneous_matrices() -> None:
    (q1, m1), (q2, m2) = _quats_and_matrices(3, 20), _quats_and_matrices(4, 20)
    t1, t2, v = torch.randn(3, 20, 3, dtype=torch.float64, generator=torch.manual_seed(0))

    def homogeneous(matrix: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        full = torch.eye(4, dtype=torch.float64).repeat(20, 1, 1)
        full[:, :3, :3], full[:, :3, 3] = matrix, t
        return full

    first, second = homogeneous(m1, t1), homogeneous(m2, t2)
    point = torch.cat((v, torch.ones(20, 1)), dim=-1).unsqueeze(-1)
    moved = (first @ point)[:, :3, 0]
    torch.testing.assert_close(published.tf_apply(q1, t1, v), moved)
    torch.testing.assert_close(published.tf_vector(q1, v), moved - t1)
    torch.testing.assert_close(
        published.local_to_world_space(v, torch.cat((t1, q1), dim=-1)), moved
    )
    q, t = published.tf_combine(q1, t1, q2, t2)
    torch.testing.assert_close(published.tf_apply(q, t, v), (first @ second @ point)[:, :3, 0])
    torch.testing.assert_close(published.tf_apply(*published.tf_inverse(q1, t1), moved), v)


def test_rotation_vectors() -> None:
    angles = torch.tensor([[0.3, -0.4, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    expected = Rotation.from_euler("xyz", angles.numpy()).as_rotvec()
    found = published.euler_xyz_to_exp_map(*angles.unbind(-1))
    torch.testing.assert_close(found, torch.from_numpy(expected))
    axis = torch.tensor([[0.0, 0.6, 0.8]])
    vectors = published.angle_axis_to_exp_map(torch.tensor([2.0]), axis)
    torch.testing.assert_close(vectors, torch.tensor([[0.0, 1.2, 1.6]]))
