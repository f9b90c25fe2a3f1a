"""Frames of a robot's measurements, without a simulator."""

from __future__ import annotations

import math

import pytest
import torch

from isaacgymenvs_lite.tasks.amp.deployable_observations import (
    add_noise,
    compute_frame,
    frame_groups,
    history_groups,
    noise_widths,
)

HALF = math.sqrt(0.5)
# Places and linear velocities differ: no robot measures them.
ROOT_STATES = torch.tensor(
    [
        [0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3],
        [5.0, -7.0, 0.3, HALF, 0.0, 0.0, HALF, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3],
        [5.0, -7.0, 0.3, 0.0, 0.0, HALF, HALF, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3],
        [0.0, 0.0, 0.0, 0.0, HALF, 0.0, HALF, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3],
    ]
)


def test_the_base_measures_in_its_own_frame():
    """Upright, a quarter turn about x, about z, about y: what is up, ahead, to the left."""
    joints = torch.zeros(4, 0)
    frame = compute_frame(ROOT_STATES, joints, joints, torch.zeros(0), joints)
    expected = [
        [0.1, 0.2, 0.3, 0.0, 0.0, -1.0],
        [0.1, 0.3, -0.2, 0.0, -1.0, 0.0],  # on its right side: y of the base points up
        [0.2, -0.1, 0.3, 0.0, 0.0, -1.0],  # turned left: x of the base is y of the world
        [-0.3, 0.2, 0.1, 1.0, 0.0, 0.0],  # on its face: x of the base points down
    ]
    torch.testing.assert_close(frame, torch.tensor(expected), atol=1e-6, rtol=0)


def test_joints_are_observed_from_the_start_pose_on():
    pos, vel = torch.tensor([[0.5, -1.0]]), torch.tensor([[2.0, 3.0]])
    action = torch.tensor([[0.25, -0.75]])
    frame = compute_frame(ROOT_STATES[:1], pos, vel, torch.tensor([0.5, 1.0]), action)
    expected = torch.tensor([[0.0, -2.0, 2.0, 3.0, 0.25, -0.75]])
    torch.testing.assert_close(frame[:, 6:], expected)


def test_the_order_is_that_of_the_play_script():
    """Exported policies are driven by this list."""
    names = ["root_ang_vel_b", "gravity_b", "dof_pos_offset", "dof_vel", "last_action"]
    assert frame_groups(29) == dict(zip(names, (3, 3, 29, 29, 29), strict=True))
    older = [f"{name}_{age}" for age in (1, 2) for name in names]
    assert list(history_groups(29, 3)) == [*names, *older]
    assert sum(history_groups(29, 3).values()) == 3 * 93


def test_noise_has_its_width_and_leaves_the_action_alone():
    torch.manual_seed(0)
    widths = noise_widths({"root_ang_vel_b": 0.2, "gravity_b": 0.05, "dof_vel": 1.5}, 2)
    frame = torch.zeros(4000, 12)
    frame[:, 5] = -1.0
    change = add_noise(frame, widths) - frame
    assert float(change[:, :3].abs().max()) == pytest.approx(0.2, rel=0.01)
    assert float(change[:, 8:10].abs().max()) == pytest.approx(1.5, rel=0.01)
    # of a uniform distribution, 1.5 / sqrt(3); 8000 numbers
    assert float(change[:, 8:10].std()) == pytest.approx(0.866, rel=0.02)
    assert not change[:, 6:8].any() and not change[:, 10:].any()
    noisy_gravity = (change + frame)[:, 3:6]
    torch.testing.assert_close(noisy_gravity.norm(dim=-1), torch.ones(4000))
    # sideways by 0.05, seen from 0.95 away
    assert 0.04 < float(noisy_gravity[:, :2].abs().max()) <= 0.05 / 0.95
    assert not frame[:, :5].any()  # the frame without noise is still there
