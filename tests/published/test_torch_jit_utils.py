"""Helpers of tensors under IsaacGymEnvs' names: by hand, and against scipy."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.published import torch_jit_utils as published

LOWER, UPPER = torch.tensor([-1.0, 0.0]), torch.tensor([3.0, 10.0])


def test_every_name_is_there() -> None:
    for name in published.__all__:
        assert callable(getattr(published, name)), name


def test_shares_of_ranges_and_back() -> None:
    values = torch.tensor([[-1.0, 10.0], [1.0, 2.5]])
    shares = torch.tensor([[-1.0, 1.0], [0.0, -0.5]])
    torch.testing.assert_close(published.unscale(values, LOWER, UPPER), shares)
    torch.testing.assert_close(published.scale(shares, LOWER, UPPER), values)
    torch.testing.assert_close(published.scale_transform(values, LOWER, UPPER), shares)
    torch.testing.assert_close(published.unscale_transform(shares, LOWER, UPPER), values)
    outside = torch.tensor([[-5.0, 11.0]])
    assert published.tensor_clamp(outside, LOWER, UPPER).tolist() == [[-1.0, 10.0]]


def test_small_helpers() -> None:
    assert published.get_axis_params(-9.8, 2) == [0.0, 0.0, -9.8]
    assert published.get_axis_params(1.0, 0, x_value=5.0) == [1.0, 0.0, 0.0]
    assert published.get_axis_params(1.0, 1, x_value=5.0) == [5.0, 1.0, 0.0]
    assert published.to_torch([1, 2], device="cpu").tolist() == [1.0, 2.0]
    assert published.copysign(-2.0, torch.tensor([-0.5, 3.0])).tolist() == [-2.0, 2.0]


def test_random_numbers() -> None:
    torch.manual_seed(0)
    drawn = published.torch_rand_float(-2.0, 4.0, (1000, 3), "cpu")
    assert drawn.shape == (1000, 3)
    assert -2.0 <= drawn.min() < -1.9
    assert 3.9 < drawn.max() <= 4.0
    directions = published.torch_random_dir_2((1000, 1), "cpu")
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(1000))
    assert directions.mean(0).abs().max() < 0.1  # three deviations of the mean: 0.067


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
