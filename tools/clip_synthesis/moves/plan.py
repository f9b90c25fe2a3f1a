"""Plans path, feet and centre of mass of a move.

The ground reaction force passes from the centre of pressure p to the centre of mass. Newton's law
then gives x'' = (g + z'') / z (x - p), and y fulfils the same equation. This is the linear inverted
pendulum of Kajita et al. (ICRA 2003) with a variable height z. In flight g + z'' = 0 and x'' = 0.
The angular momentum of the limbs shifts p.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.com_plan import GRAVITY
from tools.clip_synthesis.leg import Leg
from tools.clip_synthesis.moves.contacts import FootTrack, plan_feet
from tools.clip_synthesis.moves.move import Hop, Move
from tools.clip_synthesis.moves.path import Path, ease, follow

_NO_LOAD = 1e-9
_REACH_S = 0.12  # half width of the window that smooths the height
_RATE = 240  # samples of the plan per second
_HEIGHT_STEPS = 4  # the search for the height converges quickly
_MARGIN_S = 1.5  # standing time at both ends


@dataclass(frozen=True, eq=False)
class MovePlan:
    """The plan of a move without poses.

    Attributes:
        move: the data.
        path: path of the body.
        tracks: right and left foot.
        leg: dimensions of the legs.
        times_s: (n), times of the plan's samples.
    """

    move: Move
    path: Path
    tracks: tuple[FootTrack, FootTrack]
    leg: Leg
    times_s: FloatArray

    @classmethod
    def of(cls, move: Move, leg: Leg) -> MovePlan:
        """Plan path and feet from standing to standing."""
        steps_end_s = move.steps.first_lift_s + move.steps.count * move.steps.step_s
        hop_end_s = move.hop.stand_s[1] if move.hop else 0.0
        end_s = max(steps_end_s, hop_end_s, move.window_s[1]) + _MARGIN_S
        path = follow(move.path, end_s)
        first = -round(_MARGIN_S * _RATE)
        times_s = np.arange(first, round(end_s * _RATE) + 1) / _RATE
        return cls(move, path, plan_feet(move, path, leg), leg, times_s)

    def com(self, hip_from_com: FloatArray, shift: FloatArray) -> FloatArray:
        """Return the path (n, 3) m of the centre of mass.

        Args:
            hip_from_com: (n, 2, 3) m, from the centre of mass to both hips.
            shift: (n, 2) m^2/s^2, see `plan_com`.
        """
        move, step_s = self.move, 1.0 / _RATE
        ankles = np.stack([track.poses(self.times_s)[:, :3] for track in self.tracks], axis=1)
        knee_deg = ease(move.straightest_knee, self.times_s)[:, 0]
        reach_m = self.leg.reach(np.radians(knee_deg))
        turns = 2.0 * np.pi * self.times_s / move.sway_s
        sway = (move.sway_m[0] * np.sin(2.0 * turns), move.sway_m[1] * np.sin(turns))
        pressure = pressure_path(self.tracks, self.times_s) + np.stack(sway, axis=-1)
        height = reach_m
        com = np.zeros((len(height), 3))
        for _ in range(_HEIGHT_STEPS):
            acceleration = np.gradient(np.gradient(height, step_s), step_s)
            com[:, :2] = plan_com(pressure, height, acceleration, step_s, shift)
            com[:, 2] = height
            height = self._height(com, highest(com[:, None] + hip_from_com, ankles, reach_m))
        com[:, 2] = height
        return com

    def _height(self, com: FloatArray, room: FloatArray) -> FloatArray:
        """Return the next estimate (n) of the height; the body may rise by `room` (n) in m."""
        hop = self.move.hop
        if hop is None:
            return smooth_below(com[:, 2] + room, 1.0 / _RATE)
        standing_m = float(com[0, 2] + room[0])
        ends_s = (hop.take_off_s, hop.take_off_s + hop.flight_s)
        take_off_m, landing_m = np.interp(ends_s, self.times_s, com[:, 2] + room)
        take_off_m -= hop.give_m
        landing_m = min(take_off_m, landing_m - hop.give_m)
        return hop_height(hop, standing_m, float(take_off_m), float(landing_m), self.times_s)


def pressure_path(tracks: tuple[FootTrack, FootTrack], times_s: FloatArray) -> FloatArray:
    """Return the planned centre of pressure (n, 2) in m of both feet at times (n).

    The centre of pressure is interpolated linearly in flight.
    """
    load = np.sum([track.load(times_s) for track in tracks], axis=0)
    moment = np.sum([track.pressure_moment(times_s) for track in tracks], axis=0)
    loaded = load > _NO_LOAD
    points = moment[loaded] / load[loaded, None]
    return np.stack([np.interp(times_s, times_s[loaded], axis) for axis in points.T], axis=-1)


def plan_com(
    pressure: FloatArray,
    height_m: FloatArray,
    acceleration: FloatArray,
    step_s: float,
    shift: FloatArray,
) -> FloatArray:
    """Return the horizontal path (n, 2) in m of the centre of mass, which rests at both ends.

    Args:
        pressure: (n, 2) m, centre of pressure at times with the distance `step_s`.
        height_m: (n), height of the centre of mass.
        acceleration: (n) m/s^2, vertical acceleration of the centre of mass.
        step_s: time step.
        shift: (n, 2) m^2/s^2, rate of the angular momentum per mass, (L_y', -L_x') / m.
    """
    force = np.maximum(GRAVITY + acceleration, 0.0)
    stiffness = (force / height_m)[1:-1]
    # The ground cannot turn the body in flight, therefore the shift fades with the force.
    demand = pressure * force[:, None] + shift * np.minimum(force / GRAVITY, 1.0)[:, None]
    # Solve (x[i-1] - 2 x[i] + x[i+1]) / step^2 - k x[i] = -demand / z with x = p at both ends.
    n = len(pressure)
    bands = np.zeros((3, n))
    bands[0, 2:] = bands[2, :-2] = 1.0 / step_s**2
    bands[1] = 1.0
    bands[1, 1:-1] = -2.0 / step_s**2 - stiffness
    right = pressure.copy()
    right[1:-1] = -(demand / height_m[:, None])[1:-1]
    return solve_banded((1, 1), bands, right)


def highest(hips: FloatArray, ankles: FloatArray, reach_m: FloatArray) -> FloatArray:
    """Return how much (n) in m the body may rise within the reach of both legs.

    Args:
        hips: (n, 2, 3) m, both hips.
        ankles: (n, 2, 3) m, both ankles.
        reach_m: (n), largest distance from hip to ankle.

    Raises:
        ValueError: a foot is out of reach at any height.
    """
    offset = hips - ankles
    square = reach_m[:, None] ** 2 - (offset[..., :2] ** 2).sum(axis=-1)
    if square.min() < 0.0:
        frame = int(square.min(axis=1).argmin())
        aside = np.sqrt(reach_m[frame] ** 2 - square.min())
        raise ValueError(
            f"frame {frame}: the horizontal distance from hip to ankle is {aside:.2f} m, the leg "
            f"is {reach_m[frame]:.2f} m long; make the steps shorter"
        )
    return (np.sqrt(square) - offset[..., 2]).min(axis=1)


def smooth_below(bound: FloatArray, step_s: float) -> FloatArray:
    """Return a smooth curve (n) below `bound` (n): a running minimum, then a weighted mean.

    The samples have the distance `step_s`.
    """
    reach = round(_REACH_S / step_s)
    padded = np.pad(bound, 2 * reach, mode="edge")
    lowest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).min(axis=1)
    weights = np.hanning(2 * reach + 3)[1:-1]
    return np.convolve(lowest, weights / weights.sum(), mode="valid")


def hop_height(
    hop: Hop, standing_m: float, take_off_m: float, landing_m: float, times_s: FloatArray
) -> FloatArray:
    """Return the height (n) of the centre of mass in a jump at times (n).

    Polynomials of degree 5 join standing, lowest point, take-off, landing and standing. Free fall
    sets speed and acceleration at take-off and landing. The heights are heights of the centre of
    mass.
    """
    landing_s = hop.take_off_s + hop.flight_s
    # These are the upward accelerations at the lowest points.
    push = 2.0 * hop.crouch_m / (hop.take_off_s - hop.crouch_s) ** 2
    catch = 2.0 * hop.absorb_m / (hop.absorb_s - landing_s) ** 2
    speed = (landing_m - take_off_m) / hop.flight_s + 0.5 * GRAVITY * hop.flight_s
    knots = (
        (hop.stand_s[0], standing_m, 0.0, 0.0),
        (hop.crouch_s, standing_m - hop.crouch_m, 0.0, push),
        (hop.take_off_s, take_off_m, speed, -GRAVITY),
        (landing_s, landing_m, speed - GRAVITY * hop.flight_s, -GRAVITY),
        (hop.absorb_s, standing_m - hop.absorb_m, 0.0, catch),
        (hop.stand_s[1], standing_m, 0.0, 0.0),
    )
    return quintic(knots, times_s)


def quintic(
    knots: tuple[tuple[float, float, float, float], ...], times_s: FloatArray
) -> FloatArray:
    """Return the curve (n) at times (n) through knots (time, value, rate, acceleration).

    The curve is a polynomial of degree 5 between two knots and constant outside.
    """
    values = np.where(times_s < knots[0][0], knots[0][1], knots[-1][1]).astype(np.float64)
    for (t0, *start), (t1, *end) in itertools.pairwise(knots):
        here = (times_s >= t0) & (times_s <= t1)
        span = t1 - t0
        u = (times_s[here] - t0) / span
        low = np.array([start[0], start[1] * span, 0.5 * start[2] * span**2])
        rest = np.array([end[0], end[1] * span, end[2] * span**2])
        rest -= (low.sum(), low[1] + 2.0 * low[2], 2.0 * low[2])
        # The terms u^3, u^4 and u^5 add `rest` to value, rate and acceleration at u = 1.
        high = np.linalg.solve([[1.0, 1.0, 1.0], [3.0, 4.0, 5.0], [6.0, 12.0, 20.0]], rest)
        values[here] = np.polyval([*high[::-1], *low[::-1]], u)
    return values
