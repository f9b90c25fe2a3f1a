"""The plan of a gait: curves, legs, stance, forces."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis.com_plan import plan_com, vertical_load
from tools.clip_synthesis.cycle import PeriodicCurve, hermite
from tools.clip_synthesis.gait_data import GAITS, Gait
from tools.clip_synthesis.leg import Leg
from tools.clip_synthesis.stance import Stance


@pytest.fixture(params=["walk", "run"])
def gait(request: pytest.FixtureRequest) -> Gait:
    return GAITS[request.param]


@pytest.fixture
def stance(gait: Gait, humanoid: Skeleton) -> Stance:
    return Stance(gait, Leg.from_skeleton(humanoid))


def test_curve_passes_through_a_table_of_few_harmonics() -> None:
    phase = np.arange(20) / 20
    table = 3.0 + 2.0 * np.cos(2 * np.pi * phase) - np.sin(6 * np.pi * phase)
    curve = PeriodicCurve.through(table)
    np.testing.assert_allclose(curve(phase), table, atol=1e-12)
    between = 0.123
    expected = 3.0 + 2.0 * np.cos(2 * np.pi * between) - np.sin(6 * np.pi * between)
    assert curve(between) == pytest.approx(expected)
    assert curve(between + 1.0) == pytest.approx(expected)


def test_half_tables_are_continued() -> None:
    half = (0, 1, 2, 3, 3, 2, 1, 0, -1, -1)
    phase = np.linspace(0.0, 0.5, 7)
    odd, even = PeriodicCurve.odd(half), PeriodicCurve.even(half)
    np.testing.assert_allclose(odd(phase + 0.5), -odd(phase), atol=1e-12)
    np.testing.assert_allclose(even(phase + 0.5), even(phase), atol=1e-12)


def test_hermite_meets_values_and_rates_at_both_ends() -> None:
    start, end = (np.array([1.0]), np.array([2.0])), (np.array([0.0]), np.array([-3.0]))
    step = 1e-6
    u = np.array([0.0, step, 1.0 - step, 1.0])
    values = hermite(start, end, 0.5, u)[:, 0]
    assert values[0] == pytest.approx(1.0)
    assert values[3] == pytest.approx(0.0)
    assert (values[1] - values[0]) / (0.5 * step) == pytest.approx(2.0, rel=1e-4)
    assert (values[3] - values[2]) / (0.5 * step) == pytest.approx(-3.0, rel=1e-4)


def test_leg_has_the_dimensions_of_the_model(humanoid: Skeleton) -> None:
    lengths_m = dataclasses.astuple(Leg.from_skeleton(humanoid))
    assert lengths_m == pytest.approx((0.421546, 0.40987, 0.05, 0.0435, 0.1335))


def test_leg_angles_invert_the_ankle(humanoid: Skeleton) -> None:
    leg = Leg.from_skeleton(humanoid)
    thigh, knee = np.array([0.4, -0.2, 0.7]), np.array([0.1, 0.5, 1.6])
    found = leg.angles(*leg.ankle(thigh, knee))
    np.testing.assert_allclose(found, (thigh, knee), atol=1e-9)


def test_knee_of_a_right_angle(humanoid: Skeleton) -> None:
    leg = Leg.from_skeleton(humanoid)
    # Thigh straight down, shin straight back.
    ahead, below = leg.ankle(np.zeros(1), np.full(1, np.pi / 2))
    assert ahead[0] == pytest.approx(-leg.shin_m)
    assert below[0] == pytest.approx(leg.thigh_m)
    assert leg.reach(np.array([np.pi / 2])) == pytest.approx(np.hypot(leg.thigh_m, leg.shin_m))


def test_stance_turns_about_an_edge_that_stays(stance: Stance) -> None:
    """The lower edge of the sole is at its flat place, on the ground, at every phase."""
    gait, leg = stance.gait, stance.leg
    pose = stance.pose(np.linspace(0.0, gait.duty, 50))
    pitch = pose[:, 3]
    edge = np.where(pitch > 0.0, -leg.heel_m, leg.toe_m)
    along = edge * np.cos(pitch) + leg.ankle_height_m * np.sin(pitch)
    height = pose[:, 2] + edge * np.sin(pitch) - leg.ankle_height_m * np.cos(pitch)
    np.testing.assert_allclose(height, 0.0, atol=1e-12)
    np.testing.assert_allclose(pose[:, 0] + along * np.cos(stance.yaw), edge * np.cos(stance.yaw))
    line = pose[:, 1] + along * np.sin(stance.yaw)
    np.testing.assert_allclose(line, -0.5 * gait.step_width_m + edge * np.sin(stance.yaw))


def test_stance_goes_from_heel_to_toe(stance: Stance) -> None:
    gait, leg = stance.gait, stance.leg
    marks = np.array([0.0, gait.foot_flat, gait.heel_off, gait.duty])
    expected = np.radians((gait.strike_pitch_deg, 0.0, 0.0, gait.toe_off_pitch_deg))
    np.testing.assert_allclose(stance.pitch(marks), expected, atol=1e-12)
    along = stance.pressure_point(marks)[:, 0] / np.cos(stance.yaw)
    np.testing.assert_allclose(along, (-leg.heel_m, -leg.heel_m, leg.toe_m, leg.toe_m), atol=1e-12)


def test_two_feet_carry_one_body(gait: Gait) -> None:
    phase = (np.arange(2000) + 0.5) / 2000
    assert vertical_load(gait, phase).mean() == pytest.approx(0.5, abs=1e-4)
    assert vertical_load(gait, np.array([gait.duty + 1e-9]))[0] == 0.0


def test_force_of_a_running_step_is_half_a_sine() -> None:
    # Morin et al. 2005: peak = pi / 2 (flight / contact + 1) body weights.
    gait = GAITS["run"]
    flight = 0.5 - gait.duty
    peak = vertical_load(gait, np.array([0.5 * gait.duty]))[0]
    assert peak == pytest.approx(np.pi / 2 * (flight / gait.duty + 1.0))


def test_centre_of_mass_obeys_the_forces(stance: Stance) -> None:
    """By differences: x'' = sum F / m (x - p) / h, with the planned centres of pressure p."""
    gait, height_m = stance.gait, 0.9
    com = plan_com(stance, height_m)
    phase = np.linspace(0.02, 0.48, 24)
    step = 0.01
    acceleration = (com(phase + step) - 2.0 * com(phase) + com(phase - step)) / (
        step * gait.period_s
    ) ** 2
    expected = np.zeros_like(acceleration)
    expected[:, 2] = -9.81
    for touch_down, mirror in ((0.0, 1.0), (-0.5, -1.0)):
        since = phase - touch_down
        load = np.where(since < gait.duty, vertical_load(gait, since), 0.0)
        point = stance.pressure_point(np.clip(since, 0.0, gait.duty)) * (1.0, mirror)
        point[:, 0] += touch_down * gait.stride_m
        arm = com(phase)[:, :2] - point
        expected[:, :2] += (9.81 / height_m * load)[:, None] * arm
        expected[:, 2] += 9.81 * load
    # The plan keeps 16 harmonics of forces that have corners at touch-down and toe-off.
    np.testing.assert_allclose(acceleration, expected, atol=0.1 * 9.81)


def test_centre_of_mass_advances_by_the_stride_and_mirrors(stance: Stance) -> None:
    com = plan_com(stance, 0.9)
    phase = np.linspace(0.0, 1.0, 9)
    now, later = com(phase), com(phase + 0.5)
    np.testing.assert_allclose(later[:, 0] - now[:, 0], 0.5 * stance.gait.stride_m, atol=1e-6)
    np.testing.assert_allclose(later[:, 1], -now[:, 1], atol=1e-6)
    np.testing.assert_allclose(later[:, 2], now[:, 2], atol=1e-6)
