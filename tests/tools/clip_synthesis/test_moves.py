"""The planner of moves, piece by piece, against numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis.cycle import smoothstep
from tools.clip_synthesis.leg import Leg
from tools.clip_synthesis.model_checks import outside
from tools.clip_synthesis.moves.balance import plan_com, pressure_path
from tools.clip_synthesis.moves.contacts import (
    Contact,
    FootTrack,
    arc,
    plan_feet,
)
from tools.clip_synthesis.moves.height import (
    highest,
    hop_height,
    quintic,
    smooth_below,
)
from tools.clip_synthesis.moves.move import Move, Steps
from tools.clip_synthesis.moves.move_data import MIRRORED, MOVES
from tools.clip_synthesis.moves.path import ease, follow
from tools.clip_synthesis.moves.plan import MovePlan


@pytest.fixture
def leg(humanoid: Skeleton) -> Leg:
    return Leg.from_skeleton(humanoid)


@pytest.fixture
def contact() -> Contact:
    """Flat from 1.1 to 1.7 s; heel first, toes last; at (1, 2), pointing to +y."""
    return Contact(1.0, 1.9, (1.0, 2.0, 0.5 * math.pi), 0.2, -0.6, 0.1, 0.2, 0.1, 0.1)


def test_knots_are_joined_smoothly() -> None:
    times_s = np.array([-1.0, 0.0, 0.5, 1.0, 2.0, 9.0])
    values = ease(((0.0, 0.0), (1.0, 4.0), (3.0, 0.0)), times_s)[:, 0]
    # A quarter of the way: 3/16 - 2/64 = 5/32; halfway: 1/2.
    np.testing.assert_allclose(values, (0.0, 0.0, 2.0, 4.0, 2.0, 0.0))
    quarter = ease(((0.0, 0.0), (1.0, 32.0)), np.array([0.25]))
    np.testing.assert_allclose(quarter, [[5.0]])


def test_one_knot_is_a_constant() -> None:
    np.testing.assert_allclose(ease(((0.0, 3.0, 4.0),), np.array([-1.0, 5.0])), [[3.0, 4.0]] * 2)


def test_a_path_with_a_constant_turn_is_a_circle() -> None:
    # 1 m/s and 90 deg/s: radius 2 / pi m; after one second a quarter, after two a half.
    path = follow(((0.0, 1.0, 0.0, 90.0),), 2.0)
    radius = 2.0 / math.pi
    np.testing.assert_allclose(path(1.0), (radius, radius, 0.5 * math.pi), atol=1e-5)
    np.testing.assert_allclose(path(2.0), (0.0, 2.0 * radius, math.pi), atol=1e-5)


def test_sideways_is_left_of_the_heading() -> None:
    # A quarter turn on the spot, then 0.5 m/s to the left: along -x.
    turn_then_step = ((0.0, 0, 0, 90), (1.0, 0, 0, 90), (1.0, 0, 0.5, 0), (2.0, 0, 0.5, 0))
    path = follow(turn_then_step, 2.0)
    np.testing.assert_allclose(path(2.0), (-0.5, 0.0, 0.5 * math.pi), atol=5e-3)


def test_arc_of_a_quarter_circle() -> None:
    start, end = (0.0, 0.0, 0.0), (1.0, 1.0, 0.5 * math.pi)
    places = arc(start, end, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(places[[0, 2]], (start, end), atol=1e-12)
    # On the circle about (0, 1) the middle is (0.7071, 0.2929); with rates as long as the chord,
    # sqrt 2, the cubic is at 1/2 + sqrt 2 / 8 and 1/2 - sqrt 2 / 8.
    np.testing.assert_allclose(places[1], (0.676777, 0.323223, 0.25 * math.pi), atol=1e-6)


def test_arc_without_a_turn_is_straight() -> None:
    places = arc((0.0, 0.0, 0.3), (2.0, 1.0, 0.3), np.array([0.25]))
    np.testing.assert_allclose(places, [[0.5, 0.25, 0.3]])


def test_contact_rolls_from_heel_to_toe(contact: Contact) -> None:
    pitch = contact.pitch(np.array([1.0, 1.05, 1.1, 1.7, 1.8, 1.9]))
    np.testing.assert_allclose(pitch, (0.2, 0.1, 0.0, 0.0, -0.15, -0.6), atol=1e-12)
    assert contact.lift_rate == pytest.approx(-6.0)


def test_contact_takes_and_gives_its_load(contact: Contact) -> None:
    load = contact.load(np.array([0.9, 1.0, 1.05, 1.1, 1.8, 1.85, 1.9, 2.0]))
    np.testing.assert_allclose(load, (0, 0, 0.5, 1, 1, 0.5, 0, 0), atol=1e-12)


def test_pressure_goes_over_the_sole(contact: Contact, leg: Leg) -> None:
    """From the back edge while on the heel to the front edge while on the toes."""
    along = contact.pressure_along(np.array([1.0, 1.1, 1.4, 1.7, 1.9]), leg)
    half = 0.5 * (0.0435 + 0.1335)
    np.testing.assert_allclose(along, (-half, -half, 0.0, half, half), atol=1e-12)


def test_standing_foot_carries_in_its_middle(leg: Leg) -> None:
    endless = Contact(-math.inf, math.inf, (0.0, 0.0, 0.0), 0.2, -0.6, 0.1, 0.2, 0.1, 0.1)
    times_s = np.array([-5.0, 0.0, 5.0])
    for found, expected in (
        (endless.pitch(times_s), 0.0),
        (endless.load(times_s), 1.0),
        (endless.pressure_along(times_s, leg), 0.0),
    ):
        np.testing.assert_array_equal(found, expected)


def test_rolled_foot_with_sharp_and_rounded_edges(leg: Leg) -> None:
    ahead, up = leg.rolled(np.array([0.0, -0.5 * math.pi, 0.5 * math.pi])).T
    # Upright on its toes: the ankle is over the front edge, by the length of the foot before it,
    # and ahead of that edge by its height over the sole.
    np.testing.assert_allclose(ahead, (0.0, 0.1335 + 0.05, -0.0435 - 0.05), atol=1e-12)
    np.testing.assert_allclose(up, (0.05, 0.1335, 0.0435), atol=1e-12)
    assert leg.rolled(np.zeros(1), 0.03)[0, 1] == pytest.approx(0.05 + 0.03)


@pytest.fixture
def track(leg: Leg) -> FootTrack:
    ends = {"strike_rad": 0.2, "lift_rad": -0.6, "flat_s": 0.1, "roll_s": 0.2}
    ends |= {"load_s": 0.1, "unload_s": 0.1}
    first = Contact(-math.inf, 1.0, (0.0, 0.0, 0.0), **ends)
    second = Contact(1.4, math.inf, (0.8, 0.0, 0.0), **ends)
    return FootTrack((first, second), leg, clearance_m=0.05)


def lowest_edge(pose: np.ndarray, leg: Leg) -> np.ndarray:
    """Return the height of the lower edge of the sole of poses (n, 5)."""
    edges = np.array([[-leg.heel_m], [leg.toe_m]])
    sin, cos = np.sin(pose[:, 4]), np.cos(pose[:, 4])
    return (pose[:, 2] + edges * sin - leg.ankle_height_m * cos).min(axis=0)


def test_swing_clears_the_ground_and_stance_stays_on_it(track: FootTrack) -> None:
    times_s = np.linspace(0.5, 2.0, 301)
    edge = lowest_edge(track.poses(times_s), track.leg)
    swinging = (times_s > 1.0) & (times_s < 1.4)
    np.testing.assert_allclose(edge[~swinging], 0.0, atol=1e-12)
    assert edge.min() > -1e-12
    # The edges are rounded in mid-swing, which lifts a flat foot by up to 3 cm besides.
    assert 0.05 <= edge.max() <= 0.08 + 1e-12


def test_foot_moves_without_jumps(track: FootTrack) -> None:
    times_s = np.arange(0.5, 2.0, 1e-3)
    speeds = np.diff(track.poses(times_s), axis=0) / 1e-3
    # The minimum-jerk way over 0.8 m in 0.4 s is 15/8 of the mean speed at most, 3.75 m/s; the
    # ankle, which the roll about the toes has already brought forward, is slower.
    assert 3.0 < np.abs(speeds[:, 0]).max() < 3.75
    # The roll ends and the swing begins at the same rate: a jump of the pitch's rate, 6 rad/s,
    # would show, its acceleration in a step of 1 ms does not.
    assert np.abs(np.diff(speeds, axis=0)).max() < 0.2


def test_places_before_and_behind_the_swing(track: FootTrack) -> None:
    before, after = track.poses(np.array([0.0, 3.0]))
    middle = 0.5 * (0.1335 - 0.0435)
    np.testing.assert_allclose(before, (-middle, 0.0, 0.05, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(after, (0.8 - middle, 0.0, 0.05, 0.0, 0.0), atol=1e-12)


def test_steps_follow_the_path(leg: Leg) -> None:
    """Walking at 1 m/s with a step every 0.5 s puts the feet 0.5 m apart, each on its side."""
    steps = Steps(count=8, first_lift_s=1.0, step_s=0.5, both_s=0.1, width_m=0.2)
    move = Move("test", (0.0, 1.0), ((0.0, 1.0, 0, 0),), steps)
    right, left = plan_feet(move, follow(move.path, 8.0), leg)
    assert [len(track.contacts) for track in (right, left)] == [5, 5]
    # The left foot is lifted at 1.0 s and lands at 1.4 s; halfway through its stance of 0.6 s the
    # body is at 1.7 m. The right one lands half a second later.
    assert left.contacts[1].touch_down_s == pytest.approx(1.4)
    assert left.contacts[1].lift_off_s == pytest.approx(2.0)
    toe_out = math.radians(6.0)
    assert left.contacts[1].place == pytest.approx((1.7, 0.1, toe_out), abs=1e-6)
    assert right.contacts[1].place == pytest.approx((2.2, -0.1, -toe_out), abs=1e-6)
    assert left.contacts[2].place[0] - left.contacts[1].place[0] == pytest.approx(1.0)
    # 18 degrees per metre of way forward, which the toe-out shortens a little.
    assert left.contacts[2].strike_rad == pytest.approx(math.radians(18.0 * math.cos(toe_out)))


def test_two_feet_share_the_weight(leg: Leg) -> None:
    move = MOVES["start_walking"]
    tracks = plan_feet(move, follow(move.path, 8.0), leg)
    # In the walk the loads of both feet add up to 1 at any time; there is no flight.
    times_s = np.linspace(2.0, 4.0, 97)
    np.testing.assert_allclose(sum(track.load(times_s) for track in tracks), 1.0, atol=1e-12)
    pressure = pressure_path(tracks, np.array([-1.0, 0.0]))
    np.testing.assert_allclose(pressure, 0.0, atol=1e-9)  # standing: between both feet


def test_com_over_a_resting_pressure_rests() -> None:
    n = 50
    com = plan_com(np.full((n, 2), 0.3), np.full(n, 0.9), np.zeros(n), 0.01)
    np.testing.assert_allclose(com, 0.3)


def test_com_follows_a_swaying_pressure_with_less_sway() -> None:
    """Of x'' = k (x - p) and p = sin(w t) the solution is x = k / (k + w^2) sin(w t)."""
    step_s, omega, height = 1 / 240, 2.0 * math.pi, 0.981
    times_s = np.arange(0.0, 4.0 + step_s / 2, step_s)
    pressure = np.stack((np.sin(omega * times_s), np.zeros_like(times_s)), axis=-1)
    com = plan_com(pressure, np.full(len(times_s), height), np.zeros(len(times_s)), step_s)
    expected = 10.0 / (10.0 + omega**2) * pressure  # k = 9.81 / 0.981
    np.testing.assert_allclose(com, expected, atol=1e-4)


def test_com_goes_straight_in_free_fall() -> None:
    """No force, no acceleration, wherever the pressure is and whatever the limbs do."""
    n = 40
    acceleration = np.where((np.arange(n) >= 15) & (np.arange(n) < 25), -9.81, 0.0)
    pressure = np.random.default_rng(0).normal(size=(n, 2))
    shift = np.ones((n, 2))
    com = plan_com(pressure, np.full(n, 0.9), acceleration, 0.02, shift)
    bend = np.abs(np.diff(com, n=2, axis=0)).max(axis=1)
    assert bend[14:24].max() < 1e-12
    assert bend[:13].min() > 1e-6


def test_momentum_shifts_the_pressure() -> None:
    """A rate of angular momentum of g times 1 cm acts like a pressure 1 cm further."""
    n = 60
    args = (np.full(n, 0.9), np.zeros(n), 0.02)
    aside = np.zeros((n, 2))
    aside[20:40, 0] = 0.01
    np.testing.assert_allclose(
        plan_com(np.zeros((n, 2)), *args, shift=9.81 * aside), plan_com(aside, *args), atol=1e-12
    )


def test_room_above_the_hips() -> None:
    hips = np.array([[[0.0, 0.0, 0.8], [0.3, 0.0, 0.8]]])
    ankles = np.zeros((1, 2, 3))
    # Reach 1: the first leg has 1 - 0.8 to spare, the second sqrt(1 - 0.09) - 0.8.
    np.testing.assert_allclose(highest(hips, ankles, np.ones(1)), [math.sqrt(0.91) - 0.8])
    with pytest.raises(ValueError, match=r"a foot is 0\.30 m beside its hip.*0\.20 m long"):
        highest(hips, ankles, np.full(1, 0.2))


def test_smooth_height_stays_below_its_bound() -> None:
    times_s = np.arange(0.0, 3.0, 1 / 240)
    bound = 0.9 - 0.1 * np.abs(np.sin(6.0 * times_s))  # with kinks at the top
    height = smooth_below(bound, 1 / 240)
    assert height.shape == bound.shape
    assert (bound - height).min() > -1e-12
    assert np.abs(np.diff(height, n=2)).max() * 240**2 < 9.81  # never a pull of the ground
    np.testing.assert_allclose(smooth_below(np.full(300, 0.9), 1 / 240), 0.9)


def test_quintic_meets_all_its_knots() -> None:
    knots = ((0.0, 1.0, 0.0, 0.0), (2.0, 0.0, 3.0, -4.0))
    d = 1e-4
    times_s = np.array([-1.0, 0.0, 2.0 - 2 * d, 2.0 - d, 2.0, 5.0])
    values = quintic(knots, times_s)
    np.testing.assert_allclose(values[[0, 1, 4, 5]], (1.0, 1.0, 0.0, 0.0), atol=1e-9)
    assert (values[4] - values[3]) / d == pytest.approx(3.0, abs=1e-3)
    assert (values[4] - 2 * values[3] + values[2]) / d**2 == pytest.approx(-4.0, abs=1e-2)


def test_body_is_thrown_and_caught() -> None:
    hop = MOVES["jump"].hop
    assert hop is not None
    times_s = np.arange(0.0, 3.0, 1 / 480)
    height = hop_height(hop, 0.95, 1.0, 0.97, times_s)
    flying = (times_s > hop.take_off_s) & (times_s < hop.take_off_s + hop.flight_s)
    acceleration = np.gradient(np.gradient(height, 1 / 480), 1 / 480)
    np.testing.assert_allclose(acceleration[flying][3:-3], -9.81, atol=1e-6)
    # From 1.0 to 0.97 m in T: v = g T / 2 - 0.03 / T, top at v^2 / 2 g.
    speed = 0.5 * 9.81 * hop.flight_s - 0.03 / hop.flight_s
    assert height.max() == pytest.approx(1.0 + speed**2 / (2 * 9.81), abs=1e-4)
    assert height.min() == pytest.approx(0.95 - max(hop.crouch_m, hop.absorb_m), abs=1e-3)
    assert (acceleration > -9.81 - 1e-6).all()  # the ground never pulls
    assert height[0] == pytest.approx(0.95)
    assert height[-1] == pytest.approx(0.95)


@pytest.mark.parametrize(
    ("point", "corners", "expected"),
    [
        ((0.5, 0.5), ((0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0.5)), 0.0),
        ((1.5, 0.5), ((0, 0), (1, 0), (1, 1), (0, 1)), 0.5),
        ((2.0, 2.0), ((0, 0), (1, 0), (1, 1), (0, 1)), math.sqrt(2.0)),
        ((0.5, 0.3), ((0, 0), (1, 0)), 0.3),
        ((2.0, 0.0), ((0, 0), (1, 0)), 1.0),
        ((2.0, 0.0), ((0, 0), (1, 0), (0.5, 0.0)), 1.0),
        ((0.5, 0.0), ((0, 0), (1, 0), (0.5, 1.0)), 0.0),
        ((0.5, 0.0), ((0, 0),), math.nan),
        ((math.nan, 0.0), ((0, 0), (1, 0)), math.nan),
    ],
)
def test_distance_to_the_support(point, corners, expected) -> None:
    found = outside(np.array(point), np.array(corners, dtype=np.float64))
    assert found == pytest.approx(expected, nan_ok=True)


def test_a_move_too_fast_for_its_legs_is_refused(leg: Leg) -> None:
    """Half a second per step at 4 m/s: each foot would be a metre from its hip."""
    fast = dataclasses.replace(MOVES["start_walking"], path=((0.8, 0, 0, 0), (2.0, 4.0, 0, 0)))
    plan = MovePlan.of(fast, leg)
    n = len(plan.times_s)
    with pytest.raises(ValueError, match="make the steps shorter"):
        plan.com(np.zeros((n, 2, 3)), np.zeros((n, 2)))


@pytest.mark.parametrize("name", sorted(MOVES))
def test_moves_are_told_from_standing_to_standing(name: str) -> None:
    """The clip is inside of what is planned, and steps do not overlap."""
    move = MOVES[name]
    assert move.name == name
    assert 0.0 <= move.window_s[0] < move.window_s[1]
    assert 1.5 <= move.window_s[1] - move.window_s[0] <= 4.0
    assert move.steps.flat_s + move.steps.roll_s < move.steps.step_s + move.steps.both_s


def test_mirrored_moves_name_a_move() -> None:
    for name, original in MIRRORED.items():
        assert original in MOVES
        assert name.replace("right", "left") == original


def test_smoothstep_stops_at_both_ends() -> None:
    np.testing.assert_allclose(smoothstep(np.array([-2.0, 0.0, 0.5, 1.0, 3.0])), (0, 0, 0.5, 1, 1))
