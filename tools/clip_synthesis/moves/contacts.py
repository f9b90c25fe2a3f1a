"""Plans the feet of a move: contacts with the ground, and swings between the contacts."""

from __future__ import annotations

import cmath
import itertools
import math
from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.com_plan import GRAVITY
from tools.clip_synthesis.cycle import hermite, smoothstep
from tools.clip_synthesis.leg import Leg
from tools.clip_synthesis.moves.move import Hop, Move, Steps
from tools.clip_synthesis.moves.path import Path

Place = tuple[float, float, float]
"""The values are x and y in m and yaw in rad."""
SIDES = (("right", -1.0), ("left", 1.0))
_SETTLE_S = 0.3  # largest time of the pressure on its way over half of the sole
_FIRST_UNLOAD_S = 0.5  # time to unload the first foot of a walk
_FEET_LAG = 0.5  # the feet leave and meet the ground slower than the body by this share
_ROUNDING_M = 0.03  # radius of the sole's edges in mid-swing, see `Leg.rolled`


@dataclass(frozen=True)
class Contact:
    """One foot on the ground from touch-down to lift-off.

    Attributes:
        touch_down_s, lift_off_s: times, infinite at the ends of a move.
        place: x, y in m and yaw in rad of the middle of the sole.
        strike_rad, lift_rad: pitch at touch-down and lift-off, toes up positive.
        flat_s, roll_s: time after touch-down and before lift-off with a tilted sole.
        load_s, unload_s: time of loading after touch-down and of unloading before lift-off.
    """

    touch_down_s: float
    lift_off_s: float
    place: Place
    strike_rad: float
    lift_rad: float
    flat_s: float
    roll_s: float
    load_s: float
    unload_s: float

    def pitch(self, times_s: FloatArray) -> FloatArray:
        """Return the pitch (n) in rad at times (n) during the contact."""
        down = smoothstep((times_s - self.touch_down_s) / self.flat_s)
        roll = np.clip((times_s - self.lift_off_s) / self.roll_s + 1.0, 0.0, 1.0)
        return self.strike_rad * (1.0 - down) + self.lift_rad * roll * roll

    def load(self, times_s: FloatArray) -> FloatArray:
        """Return the load (n) of the foot at times (n) as a share of its full load."""
        on = smoothstep((times_s - self.touch_down_s) / self.load_s)
        off = smoothstep((self.lift_off_s - times_s) / self.unload_s)
        return on * off

    def pressure_along(self, times_s: FloatArray, leg: Leg) -> FloatArray:
        """Return how far (n) in m the centre of pressure is ahead of the middle of the sole.

        The centre of pressure starts and ends on the edge about which the foot turns. It moves over
        the flat sole and pauses at the middle.
        """
        half = 0.5 * (leg.heel_m + leg.toe_m)
        first, last = -half * np.sign(self.strike_rad), -half * np.sign(self.lift_rad)
        flat, roll = self.touch_down_s + self.flat_s, self.lift_off_s - self.roll_s
        travel_s = min(_SETTLE_S, 0.5 * (roll - flat))
        arrive = smoothstep((times_s - flat) / travel_s)
        leave = smoothstep((times_s - roll + travel_s) / travel_s)
        return first * (1.0 - arrive) + last * leave


@dataclass(frozen=True, eq=False)
class FootTrack:
    """The motion of one foot.

    Attributes:
        contacts: contacts in the order of time; the first and the last are unlimited.
        leg: dimensions of the leg.
        clearance_m: height of the sole's lowest edge in mid-swing.
        rise_m: additional height in the flight of a jump.
    """

    contacts: tuple[Contact, ...]
    leg: Leg
    clearance_m: float
    rise_m: float = 0.0

    def poses(self, times_s: FloatArray) -> FloatArray:
        """Return x, y, z (m) of the ankle, yaw and pitch (rad) as (n, 5) at times (n)."""
        flat = np.empty((len(times_s), 3))
        pitch, lift, rounding = (np.zeros(len(times_s)) for _ in range(3))
        for contact in self.contacts:
            here = (times_s >= contact.touch_down_s) & (times_s <= contact.lift_off_s)
            flat[here], pitch[here] = contact.place, contact.pitch(times_s[here])
        for before, after in itertools.pairwise(self.contacts):
            here = (times_s > before.lift_off_s) & (times_s < after.touch_down_s)
            span_s = after.touch_down_s - before.lift_off_s
            u = (times_s[here] - before.lift_off_s) / span_s
            flat[here] = arc(before.place, after.place, minimum_jerk(u))
            lift_rate = 2.0 * before.lift_rad / before.roll_s
            leave = np.array([before.lift_rad]), np.array([lift_rate])
            arrive = np.array([after.strike_rad]), np.zeros(1)
            pitch[here] = hermite(leave, arrive, span_s, u)[:, 0]
            bump = np.sin(np.pi * u) ** 2
            late = u - _FEET_LAG * np.sin(2.0 * np.pi * u) / (2.0 * np.pi)
            lift[here] = self.clearance_m * bump + 4.0 * self.rise_m * late * (1.0 - late)
            rounding[here] = _ROUNDING_M * bump
        ahead, up = self.leg.rolled(pitch, rounding).T
        ahead = ahead - 0.5 * (self.leg.toe_m - self.leg.heel_m)
        x, y = flat[:, 0] + ahead * np.cos(flat[:, 2]), flat[:, 1] + ahead * np.sin(flat[:, 2])
        return np.stack((x, y, up + lift, flat[:, 2], pitch), axis=-1)

    def load(self, times_s: FloatArray) -> FloatArray:
        """Return the load (n) as a share of the foot's full load, 0 in the air."""
        return np.sum([contact.load(times_s) for contact in self.contacts], axis=0)

    def pressure_moment(self, times_s: FloatArray) -> FloatArray:
        """Return the load times the centre of pressure (n, 2) in m."""
        moment = np.zeros((len(times_s), 2))
        for contact in self.contacts:
            x, y, yaw = contact.place
            along = contact.pressure_along(times_s, self.leg)[:, None]
            point = np.array((x, y)) + along * (math.cos(yaw), math.sin(yaw))
            moment += contact.load(times_s)[:, None] * point
        return moment


def minimum_jerk(u: FloatArray) -> FloatArray:
    """Return 10 u^3 - 15 u^4 + 6 u^5 (Flash and Hogan, J. Neurosci. 5 (1985) 1688-1703)."""
    return u**3 * (10.0 - 15.0 * u + 6.0 * u * u)


def arc(start: Place, end: Place, u: FloatArray) -> FloatArray:
    """Return x, y, yaw (n, 3) at u (n) on an arc from `start` (u = 0) to `end` (u = 1).

    Yaw and direction of travel turn together, therefore a foot passes the other foot on a curve.
    """
    (x, y, yaw), (end_x, end_y, end_yaw) = start, end
    chord = complex(end_x - x, end_y - y)
    # The tangents at both ends of a circular arc differ from the chord by half of the turn.
    tangents = [chord * cmath.exp(0.5j * sign * (end_yaw - yaw)) for sign in (-1.0, 1.0)]
    rates = [np.array((tangent.real, tangent.imag, end_yaw - yaw)) for tangent in tangents]
    return hermite((np.array(start), rates[0]), (np.array(end), rates[1]), 1.0, u)


def plan_feet(move: Move, path: Path, leg: Leg) -> tuple[FootTrack, FootTrack]:
    """Plan the motion of the right and the left foot."""
    if move.hop is not None:
        right, left = (_hop_contacts(move.hop, move.steps, side) for _, side in SIDES)
        tuck_m, rise_m = move.hop.tuck_m, GRAVITY * move.hop.flight_s**2 / 8.0
        return FootTrack(right, leg, tuck_m, rise_m), FootTrack(left, leg, tuck_m, rise_m)
    right, left = (_step_contacts(move.steps, path, name, side) for name, side in SIDES)
    clearance_m = move.steps.clearance_m
    return FootTrack(right, leg, clearance_m), FootTrack(left, leg, clearance_m)


def _step_contacts(steps: Steps, path: Path, foot: str, side: float) -> tuple[Contact, ...]:
    """Return the contacts of one foot along the path, from standing to standing."""
    late = 0 if foot == steps.first_foot else 1
    lift_s = [steps.first_lift_s + k * steps.step_s for k in range(late, steps.count, 2)]
    down_s = [time + steps.step_s - steps.both_s for time in lift_s]
    stance_s = steps.step_s + steps.both_s
    # A foot is placed next to the body's position at the middle of the stance.
    places = [
        _place(steps, path, side, time) for time in (0.0, *(t + 0.5 * stance_s for t in down_s))
    ]
    ways = [0.0, *(_way_forward(a, b) for a, b in itertools.pairwise(places)), 0.0]
    contacts = []
    for i, place in enumerate(places):
        last, first = i == len(lift_s), i == 0
        lift_deg = steps.lift_deg + steps.lift_deg_per_m * ways[i + 1]
        contacts.append(
            Contact(
                touch_down_s=-math.inf if first else down_s[i - 1],
                lift_off_s=math.inf if last else lift_s[i],
                place=place,
                strike_rad=math.radians(steps.strike_deg_per_m * ways[i]),
                lift_rad=0.0 if last else math.radians(lift_deg),
                flat_s=steps.flat_s,
                roll_s=steps.roll_s,
                load_s=steps.both_s,
                unload_s=_FIRST_UNLOAD_S if first and late == 0 else steps.both_s,
            )
        )
    return tuple(contacts)


def _hop_contacts(hop: Hop, steps: Steps, side: float) -> tuple[Contact, ...]:
    """Return the two contacts of one foot that jumps along +x."""
    yaw = side * math.radians(steps.toe_out_deg)
    y = 0.5 * side * steps.width_m
    landing_s = hop.take_off_s + hop.flight_s
    spans = ((-math.inf, hop.take_off_s), (landing_s, math.inf))
    pitches = ((0.0, hop.lift_deg), (hop.strike_deg, 0.0))
    return tuple(
        Contact(
            touch_down_s=start,
            lift_off_s=end,
            place=(x, y, yaw),
            strike_rad=math.radians(strike),
            lift_rad=math.radians(lift),
            flat_s=hop.flat_s,
            roll_s=hop.roll_s,
            load_s=1e-6,  # both feet share the weight during the whole contact
            unload_s=1e-6,
        )
        for (start, end), (strike, lift), x in zip(
            spans, pitches, (0.0, hop.forward_m), strict=True
        )
    )


def _place(steps: Steps, path: Path, side: float, time_s: float) -> Place:
    """Return the place of a foot next to the path's position at a time."""
    x, y, yaw = (float(value) for value in path(time_s))
    aside = 0.5 * side * steps.width_m
    toe_out = side * math.radians(steps.toe_out_deg)
    return x - aside * math.sin(yaw), y + aside * math.cos(yaw), yaw + toe_out


def _way_forward(start: Place, end: Place) -> float:
    """Return the length of a step in m along the mean direction of the foot."""
    yaw = 0.5 * (start[2] + end[2])
    return (end[0] - start[0]) * math.cos(yaw) + (end[1] - start[1]) * math.sin(yaw)
