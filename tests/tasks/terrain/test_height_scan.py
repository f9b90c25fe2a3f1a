"""What robots see of the ground."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.tasks.anymal_terrain_terms import NUM_POINTS, HeightScan, scan_points
from isaacgymenvs_lite.tasks.terrain.grid import Terrain
from isaacgymenvs_lite.utils.rotations import quat_from_euler_xyz

CPU = torch.device("cpu")


def _terrain() -> Terrain:
    """Return ground of which each sample tells its place: 10 i + j units, border 2 m."""
    i, j = np.meshgrid(np.arange(100), np.arange(90), indexing="ij")
    return Terrain((10 * i + j).astype(np.int16), np.zeros((1, 1, 3)), 2.0)


def _rotations(roll: float, pitch: float, yaw: float) -> torch.Tensor:
    return quat_from_euler_xyz(*(torch.tensor([v]) for v in (roll, pitch, yaw)))


def test_the_points_of_the_specification() -> None:
    points = scan_points()
    assert points.shape == (2, NUM_POINTS) == (2, 140)
    assert points[:, 0].tolist() == pytest.approx([-0.8, -0.5])
    assert points[:, 1].tolist() == pytest.approx([-0.8, -0.4])
    assert points[:, 9].tolist() == pytest.approx([-0.8, 0.5])
    assert points[:, 10].tolist() == pytest.approx([-0.7, -0.5])
    assert points[:, 139].tolist() == pytest.approx([0.8, 0.5])
    assert points.abs().min() == pytest.approx(0.1)


def test_heights_under_a_robot() -> None:
    """By the lower of two opposite corners of each point's square, whatever the roll is."""
    for yaw in [0.0, math.pi / 2, 1.1, -2.5]:
        for roll in [0.0, 0.3]:
            root = torch.tensor([[1.23, 2.37, 9.0]])
            heights = HeightScan(_terrain(), CPU)(root, _rotations(roll, 0.0, yaw))[:, 0]
            # Roll and yaw leave z and w in the ratio of the yaw alone.
            for place, (ahead, aside) in enumerate(scan_points().t().tolist()):
                x = 1.23 + math.cos(yaw) * ahead - math.sin(yaw) * aside
                y = 2.37 + math.sin(yaw) * ahead + math.cos(yaw) * aside
                # The ground rises along both axes, so that the first corner is the lower one.
                expected = 0.005 * (10 * int((x + 2.0) / 0.1) + int((y + 2.0) / 0.1))
                assert heights[place].item() == pytest.approx(expected, abs=1e-5), place


def test_the_lower_corner_counts() -> None:
    samples = np.zeros((40, 40), dtype=np.int16)
    samples[20:] = -100  # a step down along x
    heights = HeightScan(Terrain(samples, np.zeros((1, 1, 3)), 0.0), CPU)(
        torch.tensor([[1.75, 2.05, 0.0]]), _rotations(0.0, 0.0, 0.0)
    ).reshape(14, 10)
    # Points at 1.75 + x: those from x = 0.2 on are in the square before the step or behind it.
    assert heights[:, 0].tolist() == pytest.approx([0.0] * 7 + [-0.5] * 7)


def test_outside_the_ground_its_edge_is_seen() -> None:
    heights = HeightScan(_terrain(), CPU)(
        torch.tensor([[-50.0, -50.0, 0.0], [50.0, 50.0, 0.0]]), _rotations(0, 0, 0).repeat(2, 1)
    )
    assert heights[:, 0].unique().tolist() == [0.0]
    assert heights[:, 1].unique().tolist() == pytest.approx([0.005 * (980 + 88)])
