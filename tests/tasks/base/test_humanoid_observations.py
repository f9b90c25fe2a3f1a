"""Observation, termination and PD targets with numbers from the specification or by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks.base.humanoid_observations import (
    compute_humanoid_observations,
    compute_humanoid_reset,
    dof_to_obs,
    num_humanoid_obs,
    pd_action_offset_scale,
)

# The specification prints six digits.
SIX_DIGITS = 1.1e-6
Q = torch.tensor([0.1, -0.2, 0.3, 0.9]) / math.sqrt(0.95)
IDENTITY_6D = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 1.0])
# Facing +y: a quarter turn about z.
TURNED_LEFT = torch.tensor([0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)])

# First slot, first degree of freedom and size of each joint's entry in the observation.
JOINT_SLOTS = [
    ("abdomen", 13, 0, 3),
    ("neck", 19, 3, 3),
    ("right_shoulder", 25, 6, 3),
    ("right_elbow", 31, 9, 1),
    ("left_shoulder", 32, 10, 3),
    ("left_elbow", 38, 13, 1),
    ("right_hip", 39, 14, 3),
    ("right_knee", 45, 17, 1),
    ("right_ankle", 46, 18, 3),
    ("left_hip", 52, 21, 3),
    ("left_knee", 58, 24, 1),
    ("left_ankle", 59, 25, 3),
]


def _close(actual: Tensor, expected: Tensor | list[float], atol: float = 1e-6) -> None:
    torch.testing.assert_close(actual, torch.as_tensor(expected), rtol=0.0, atol=atol)


def _observe(
    rotation: Tensor = torch.tensor([0.0, 0.0, 0.0, 1.0]),  # noqa: B008
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: tuple[float, ...] = (0.0,) * 6,
    dof_pos: Tensor | None = None,
    dof_vel: Tensor | None = None,
    key_body_pos: Tensor | None = None,
    local_root_obs: bool = False,
) -> Tensor:
    root = torch.cat((torch.tensor(position), rotation, torch.tensor(velocity)))
    zeros = torch.zeros(28)
    return compute_humanoid_observations(
        root.unsqueeze(0),
        (zeros if dof_pos is None else dof_pos).unsqueeze(0),
        (zeros if dof_vel is None else dof_vel).unsqueeze(0),
        (torch.zeros(4, 3) if key_body_pos is None else key_body_pos).unsqueeze(0),
        local_root_obs,
    )[0]


# --- joint positions --------------------------------------------------------------------------


def test_a_joint_is_seen_in_its_slots_only() -> None:
    for _, slot, dof, size in JOINT_SLOTS:
        dof_pos = torch.zeros(28)
        expected = _observe()
        if size == 3:
            # Check value of the specification for this rotation vector.
            dof_pos[dof : dof + 3] = torch.tensor([0.3, -0.2, 0.5])
            encoded = torch.tensor([0.859534, 0.439868, 0.260227, -0.114917, -0.329794, 0.937032])
            expected[slot : slot + 6] = encoded
        else:
            dof_pos[dof] = -0.7
            expected[slot] = -0.7
        _close(_observe(dof_pos=dof_pos), expected, SIX_DIGITS)
        _close(dof_to_obs(dof_pos.unsqueeze(0))[0], expected[13:65], SIX_DIGITS)


# --- root -------------------------------------------------------------------------------------


def test_joints_as_ase_encodes_them() -> None:
    dof_pos = torch.zeros(1, 28)
    dof_pos[0, 9], dof_pos[0, 24] = -0.7, 0.3  # right elbow, left knee
    dof_pos[0, 3:6] = torch.tensor([0.0, 0.0, 1.5 * math.pi])  # neck, a quarter turn back
    encoded = dof_to_obs(dof_pos, as_ase=True)[0]
    assert encoded.shape == (72,)
    joints = encoded.view(12, 6)
    _close(joints[3], [0.764842, 0.0, 0.644218, -0.644218, 0.0, 0.764842], SIX_DIGITS)
    cos, sin = math.cos(0.3), math.sin(0.3)
    _close(joints[10], [cos, 0.0, -sin, sin, 0.0, cos], SIX_DIGITS)
    _close(joints[1], [0.0, -1.0, 0.0, 0.0, 0.0, 1.0], SIX_DIGITS)
    for joint in (0, 2, 4, 5, 6, 7, 8, 9, 11):
        _close(joints[joint], IDENTITY_6D, SIX_DIGITS)


def test_root_rotation_of_the_specification() -> None:
    full = [0.726316, 0.526316, 0.442105, -0.315789, -0.315789, 0.894737]
    without_heading = [0.896963, 0.0, 0.442105, -0.441008, -0.070413, 0.894737]
    _close(_observe(rotation=Q)[1:7], full, SIX_DIGITS)
    _close(_observe(rotation=Q, local_root_obs=True)[1:7], without_heading, SIX_DIGITS)


def test_velocities_are_in_the_heading_frame_always() -> None:
    for local_root_obs in [False, True]:
        observed = _observe(
            rotation=Q,
            velocity=(1.0, 0.2, 0.1, -2.0, -0.4, 0.3),
            local_root_obs=local_root_obs,
        )
        # World vector (1, 0.2, 0.1) of the specification; the other is -2 times its first two.
        _close(observed[7:10], [0.927105, -0.424825, 0.1], SIX_DIGITS)
        _close(observed[10:13], [-1.854210, 0.849650, 0.3], 2.0 * SIX_DIGITS)


def test_key_bodies_relative_to_the_root_in_the_heading_frame() -> None:
    # Facing +y: a point to the north is ahead, one to the east (+x) is on the right (-y).
    root = (5.0, -3.0, 0.8)
    key_bodies = torch.tensor(
        [[5.0, -1.0, 0.8], [6.0, -3.0, 0.9], [5.0, -3.0, 0.0], [4.0, -4.0, 1.8]]
    )
    observed = _observe(rotation=TURNED_LEFT, position=root, key_body_pos=key_bodies)
    expected = [2.0, 0.0, 0.0, 0.0, -1.0, 0.1, 0.0, 0.0, -0.8, -1.0, 1.0, 1.0]
    _close(observed[93:105], expected)


def test_layout_of_all_parts() -> None:
    dof_vel = torch.arange(28.0)
    observed = _observe(
        rotation=TURNED_LEFT,
        position=(7.0, 8.0, 0.9),
        velocity=(0.0, 1.0, 0.5, 0.0, 0.0, 2.0),
        dof_vel=dof_vel,
        key_body_pos=torch.tensor([7.0, 8.0, 0.9]).expand(4, 3),
    )
    assert observed.shape == (105,)
    _close(observed[0], torch.tensor(0.9))
    _close(observed[1:7], [0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    _close(observed[7:13], [1.0, 0.0, 0.5, 0.0, 0.0, 2.0])
    assert torch.equal(observed[65:93], dof_vel)
    _close(observed[93:105], [0.0] * 12)


def test_where_the_root_faces_does_not_matter_but_for_its_own_rotation() -> None:
    for local_root_obs in [False, True]:
        # Turn and move the whole world: only the six numbers of the root rotation may change.
        generator = torch.Generator().manual_seed(0)
        keys = torch.randn(4, 3, generator=generator)
        observed = _observe(
            rotation=torch.tensor([0.0, 0.0, 0.0, 1.0]),
            velocity=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
            key_body_pos=keys,
            local_root_obs=local_root_obs,
        )
        x, y, z = keys.unbind(-1)
        turned = _observe(
            rotation=TURNED_LEFT,
            velocity=(-2.0, 1.0, 3.0, -5.0, 4.0, 6.0),
            key_body_pos=torch.stack((-y, x, z), dim=-1),
            local_root_obs=local_root_obs,
        )
        rest = [0, *range(7, 105)]
        _close(turned[rest], observed[rest], 2e-6)
        same = torch.allclose(turned[1:7], observed[1:7], atol=1e-6)
        assert same == local_root_obs


def test_without_a_heading_the_world_s_axes_count() -> None:
    for local_root_obs in [False, True]:
        for lying in [[0.5, 0.5, -0.5, 0.5], [0.5, -0.5, 0.5, 0.5]]:
            # The root's x axis points straight down or up, exactly.
            observed = _observe(
                rotation=torch.tensor(lying),
                velocity=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
                local_root_obs=local_root_obs,
            )
            _close(observed[7:13], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
            assert observed.isfinite().all()
            _close(observed[1:3], [0.0, 0.0])
            assert float(observed[3].abs()) == pytest.approx(1.0)


# --- termination ------------------------------------------------------------------------------

TORSO, HEAD, RIGHT_LOWER_ARM, PELVIS, RIGHT_FOOT, LEFT_FOOT = 1, 2, 4, 0, 11, 14


def _reset(
    touched: tuple[int, ...],
    low: tuple[int, ...],
    progress: int = 50,
    force: tuple[float, float, float] = (0.0, 0.0, 5.0),
    early: bool = True,
) -> tuple[int, int]:
    """Reset and terminate flags with these bodies touched and low, all others at 0.9 m."""
    forces, positions = torch.zeros(2, 15, 3), torch.zeros(2, 15, 3)
    positions[..., 2] = 0.9
    for body in touched:
        forces[1, body] = torch.tensor(force)
    for body in low:
        positions[1, body, 2] = 0.2
    inputs = forces.clone(), positions.clone()
    reset, terminate = compute_humanoid_reset(
        torch.zeros(2, dtype=torch.int64),
        torch.tensor([50, progress]),
        forces,
        torch.tensor([RIGHT_FOOT, LEFT_FOOT]),
        positions,
        300,
        early,
        0.5,
    )
    assert reset.dtype == terminate.dtype == torch.int64
    assert (reset[0], terminate[0]) == (0, 0)  # the standing neighbour
    assert torch.equal(forces, inputs[0])
    assert torch.equal(positions, inputs[1])
    return int(reset[1]), int(terminate[1])


def test_falls() -> None:
    for touched, low, progress, expected in [
        ((TORSO,), (TORSO,), 50, 1),
        ((RIGHT_LOWER_ARM,), (HEAD,), 50, 1),  # different bodies
        ((TORSO,), (), 50, 0),
        ((), (TORSO,), 50, 0),
        ((RIGHT_FOOT,), (PELVIS,), 50, 0),
        ((TORSO,), (RIGHT_FOOT, LEFT_FOOT), 50, 0),
        ((RIGHT_FOOT, LEFT_FOOT), (RIGHT_FOOT, LEFT_FOOT), 50, 0),
        ((TORSO,), (TORSO,), 1, 0),  # too early in the episode
        ((TORSO,), (TORSO,), 2, 1),
        ((TORSO,), (TORSO,), 299, 1),  # at the time limit it is a fall, too
    ]:
        assert _reset(touched, low, progress) == (expected, expected)
        assert _reset(touched, low, progress, early=False) == (int(progress == 299), 0)


def test_force_that_counts_as_contact() -> None:
    for force, expected in [
        ((0.1, 0.1, 0.1), 0),  # the threshold is 0.1 N in any axis
        ((0.0, 0.0, 0.11), 1),
        ((-0.2, 0.0, 0.0), 1),  # any direction counts, not only along +x, +y, +z
        ((0.0, -0.11, 0.0), 1),
        ((-0.09, 0.09, -0.09), 0),
    ]:
        assert _reset((TORSO,), (TORSO,), force=force) == (expected, expected)


def test_the_time_limit_resets_without_terminating() -> None:
    for early in [True, False]:
        for progress, expected in [(298, 0), (299, 1), (300, 1)]:
            assert _reset((), (), progress, early=early) == (expected, 0)


# --- PD targets -------------------------------------------------------------------------------

OFFSETS = (0, 3, 6, 9, 10, 13, 14, 17, 18, 21, 24, 25, 28)
ELBOWS, KNEES = (9, 13), (17, 24)


def test_offsets_and_scales_of_the_humanoid() -> None:
    # Limits in degrees, as published; those of the ball joints must not matter.
    lower, upper = torch.full((28,), -0.4), torch.full((28,), 0.7)
    for dof in ELBOWS:
        lower[dof], upper[dof] = math.radians(-160.0), 0.0
    for dof in KNEES:
        lower[dof], upper[dof] = 0.0, math.radians(160.0)
    offset, scale = pd_action_offset_scale(lower, upper, OFFSETS)
    expected_offset, expected_scale = torch.zeros(28), torch.full((28,), 3.14159)
    expected_offset[list(ELBOWS)], expected_scale[list(ELBOWS)] = -1.39626, 1.95477
    expected_offset[list(KNEES)], expected_scale[list(KNEES)] = 1.39626, 1.95477
    # the table has five decimals
    _close(offset, expected_offset, 5.1e-6)
    _close(scale, expected_scale, 5.1e-6)


def test_joints_of_any_robot_are_encoded_by_their_layout() -> None:
    """A hinge, a ball joint and a hinge, and hinges only; 5 DOFs belong to no shipped humanoid."""
    dof_pos = torch.tensor([[0.3, 0.0, 0.0, 0.5, -4.0]])
    mixed = dof_to_obs(dof_pos, dof_offsets=(0, 1, 4, 5))
    cos, sin = math.cos(0.5), math.sin(0.5)
    turned = [cos, sin, 0.0, 0.0, 0.0, 1.0]  # the x and the z axis, turned about z
    _close(mixed[0], torch.tensor([0.3, *turned, -4.0]))
    hinges = (0, 1, 2, 3, 4, 5)
    _close(dof_to_obs(dof_pos, dof_offsets=hinges), dof_pos)
    assert dof_to_obs(dof_pos, True, hinges).shape == (1, 30)
    assert num_humanoid_obs(hinges, 2) == 13 + 5 + 5 + 6
    root, keys = torch.zeros(1, 13), torch.zeros(1, 2, 3)
    root[:, 6] = 1.0
    obs = compute_humanoid_observations(root, dof_pos, 2.0 * dof_pos, keys, True, False, hinges)
    _close(obs[0, 13:23], torch.cat((dof_pos, 2.0 * dof_pos), dim=1)[0])
    assert obs.shape == (1, 29)
    with pytest.raises(ConfigError, match="no humanoid with 5 degrees of freedom is shipped"):
        dof_to_obs(dof_pos)
