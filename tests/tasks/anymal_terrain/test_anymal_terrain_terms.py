"""AnymalTerrain's formulas, by hand."""

from __future__ import annotations

import math

import pytest
import torch

from isaacgymenvs_lite.tasks.anymal_terrain_terms import (
    TERM_NAMES,
    TerrainLearnConfig,
    WalkStep,
    compute_air_time,
    compute_anymal_terrain_observations,
    compute_anymal_terrain_reward,
    noise_widths,
)
from isaacgymenvs_lite.tasks.base.velocity_tracking import BaseMotion


def _columns(*rows: float) -> torch.Tensor:
    """Return quantities (len, 1) of one environment."""
    return torch.tensor(rows, dtype=torch.float32)[:, None]


def _still() -> WalkStep:
    """Return a robot at rest that is told to be."""
    none, joints = torch.zeros(3, 1), torch.zeros(12, 1)
    return WalkStep(
        motion=BaseMotion(none, none, _columns(0.0, 0.0, -1.0)),
        commands=torch.zeros(4, 1),
        base_height=torch.tensor([0.52]),
        dof_offset=joints,
        dof_vel=joints,
        last_dof_vel=joints,
        torques=joints,
        actions=joints,
        last_actions=joints,
        knees_in_contact=torch.zeros(4, 1, dtype=torch.bool),
        foot_forces=torch.zeros(3, 4, 1),
        air_time_beyond_s=torch.zeros(1),
    )


# All scales that are off by default, and the published ones.
_CFG = TerrainLearnConfig(
    orientation_reward=-1.0, base_height_reward=-2.0, stumble_reward=-3.0, hip_reward=-4.0
)
_MOVING = BaseMotion(_columns(0.5, 0.2, 0.3), _columns(0.4, -0.3, 0.1), _columns(0.6, 0.0, -0.8))
_FEET = torch.zeros(3, 4, 1)
_FEET[:, 0, 0] = torch.tensor([4.0, 4.0, 0.5])  # sqrt(32) > 5 from the side, nothing from below
_FEET[:, 1, 0] = torch.tensor([9.0, 0.0, 2.0])  # stands
_FEET[:, 2, 0] = torch.tensor([0.0, 4.9, 0.0])  # hardly touched


def test_terms() -> None:
    for changes, name, expected in [
        ({"motion": _MOVING}, "lin_vel_xy", math.exp(-(0.5**2 + 0.2**2) / 0.25)),
        ({"motion": _MOVING}, "ang_vel_z", 0.5 * math.exp(-(0.1**2) / 0.25)),
        ({"motion": _MOVING}, "lin_vel_z", -4.0 * 0.09),
        ({"motion": _MOVING}, "ang_vel_xy", -0.05 * 0.25),
        ({"motion": _MOVING}, "orient", -0.36),
        ({"torques": torch.full((12, 1), 5.0)}, "torques", -0.00002 * 300.0),
        ({"last_dof_vel": torch.full((12, 1), 2.0)}, "joint_acc", -0.0005 * 48.0),
        ({"base_height": torch.tensor([0.42])}, "base_height", -2.0 * 0.01),
        ({"knees_in_contact": torch.tensor([[True], [False], [True], [False]])}, "collision", -0.5),
        ({"foot_forces": _FEET}, "stumble", -3.0),
        ({"last_actions": torch.full((12, 1), 0.5)}, "action_rate", -0.01 * 3.0),
        ({"dof_offset": torch.arange(-5.0, 7.0)[:, None]}, "hip", -4.0 * (5 + 2 + 1 + 4)),
    ]:
        terms = compute_anymal_terrain_reward(_still()._replace(**changes), _CFG, 0.02)
        assert terms[name].item() == pytest.approx(expected * 0.02, rel=1e-5)
        # The others are those of a robot that does as it is told.
        others = {"lin_vel_xy": 0.02, "ang_vel_z": 0.01}
        if "motion" not in changes:
            for other in set(TERM_NAMES) - {name}:
                assert terms[other].item() == pytest.approx(others.get(other, 0.0), abs=1e-8), other


def test_air_time_counts_where_a_robot_shall_walk() -> None:
    for speed, counts in [(0.11, True), (0.09, False)]:
        step = _still()._replace(
            commands=_columns(0.0, -speed, 1.0, 0.0), air_time_beyond_s=torch.tensor([0.3])
        )
        terms = compute_anymal_terrain_reward(step, _CFG, 0.02)
        assert terms["air_time"].item() == pytest.approx(0.006 if counts else 0.0)


def test_air_time_is_paid_at_the_landing() -> None:
    before = torch.tensor([[0.6], [0.2], [0.0], [0.7]])
    grounded = torch.tensor([[True], [True], [True], [False]])
    after, beyond = compute_air_time(before, grounded, 0.02)
    # The first two land; the third stood; the fourth flies on.
    assert beyond.item() == pytest.approx((0.62 - 0.5) + (0.22 - 0.5))
    assert after.flatten().tolist() == pytest.approx([0.0, 0.0, 0.0, 0.72])


def test_order_scales_and_clamp_of_the_observation() -> None:
    motion = BaseMotion(_columns(1, 2, 3), _columns(4, 5, 6), _columns(7, 8, 9))
    dofs, ground = torch.arange(12.0)[:, None], torch.linspace(-2.0, 2.0, 140)[:, None]
    rows = compute_anymal_terrain_observations(
        motion,
        _columns(10, 11, 12, 99),
        dofs,
        100.0 + dofs,
        torch.tensor([0.6]),
        ground,
        200.0 + dofs,
        TerrainLearnConfig(),
    )
    assert rows.shape == (1, 188)
    assert rows[0, :36].tolist() == pytest.approx(
        [2, 4, 6, 1, 1.25, 1.5, 7, 8, 9, 20, 22, 3]
        + list(range(12))
        + [0.05 * (100 + i) for i in range(12)]
    )
    heights = [5.0 * max(-1.0, min(1.0, 0.1 - h)) for h in ground[:, 0].tolist()]
    assert rows[0, 36:176].tolist() == pytest.approx(heights, abs=1e-5)
    assert rows[0, 176:].tolist() == [200 + i for i in range(12)]


def test_noise_of_the_specification() -> None:
    widths = noise_widths(TerrainLearnConfig())
    expected = [0.2] * 3 + [0.05] * 3 + [0.05] * 3 + [0.0] * 3
    expected += [0.01] * 12 + [0.075] * 12 + [0.3] * 140 + [0.0] * 12
    assert widths.tolist() == pytest.approx(expected)
    doubled = noise_widths(TerrainLearnConfig(noise_level=2.0, height_scale=1.0))
    assert doubled[[0, 40]].tolist() == pytest.approx([0.4, 0.12])
