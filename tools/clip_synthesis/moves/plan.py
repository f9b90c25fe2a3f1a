"""The plan of a move: path, feet and centre of mass, before there are poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.leg import Leg
from tools.clip_synthesis.moves.balance import plan_com, pressure_path
from tools.clip_synthesis.moves.contacts import FootTrack, plan_feet
from tools.clip_synthesis.moves.height import highest, hop_height, smooth_below
from tools.clip_synthesis.moves.move import Move
from tools.clip_synthesis.moves.path import Path, ease, follow

_RATE = 240  # of the plan, per second
_HEIGHT_STEPS = 4  # of the search for the height, which closes in quickly
_MARGIN_S = 1.5  # of standing before the first and behind the last thing that happens


@dataclass(frozen=True, eq=False)
class MovePlan:
    """Everything about a move that is known before its poses are.

    Attributes:
        move: the data.
        path: where the body goes.
        tracks: right and left foot.
        leg: the dimensions.
        times_s: (n), the grid of the plan.
    """

    move: Move
    path: Path
    tracks: tuple[FootTrack, FootTrack]
    leg: Leg
    times_s: FloatArray

    @classmethod
    def of(cls, move: Move, leg: Leg) -> MovePlan:
        """Plan path and feet, from standing to standing."""
        steps_end_s = move.steps.first_lift_s + move.steps.count * move.steps.step_s
        hop_end_s = move.hop.stand_s[1] if move.hop else 0.0
        end_s = max(steps_end_s, hop_end_s, move.window_s[1]) + _MARGIN_S
        path = follow(move.path, end_s)
        first = -round(_MARGIN_S * _RATE)
        times_s = np.arange(first, round(end_s * _RATE) + 1) / _RATE
        return cls(move, path, plan_feet(move, path, leg), leg, times_s)

    def pressure(self) -> FloatArray:
        """Return the planned centre of pressure (n, 2) m."""
        move = self.move
        turns = 2.0 * np.pi * self.times_s / move.sway_s
        forward, left = move.sway_m[0] * np.sin(2.0 * turns), move.sway_m[1] * np.sin(turns)
        return pressure_path(self.tracks, self.times_s) + np.stack((forward, left), axis=-1)

    def com(self, hip_from_com: FloatArray, shift: FloatArray) -> FloatArray:
        """Return the path (n, 3) m of the centre of mass.

        Args:
            hip_from_com: (n, 2, 3) m, from the centre of mass to both hips.
            shift: (n, 2) m^2/s^2, see `plan_com`.
        """
        step_s = 1.0 / _RATE
        ankles = np.stack([track.poses(self.times_s)[:, :3] for track in self.tracks], axis=1)
        knee_deg = ease(self.move.straightest_knee, self.times_s)[:, 0]
        reach_m = self.leg.reach(np.radians(knee_deg))
        pressure = self.pressure()
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
        """Return the next guess (n) of the height, `room` (n) m above the one before."""
        hop = self.move.hop
        if hop is None:
            return smooth_below(com[:, 2] + room, 1.0 / _RATE)
        standing_m = float(com[0, 2] + room[0])
        ends_s = (hop.take_off_s, hop.take_off_s + hop.flight_s)
        take_off_m, landing_m = np.interp(ends_s, self.times_s, com[:, 2] + room)
        take_off_m -= hop.give_m
        landing_m = min(take_off_m, landing_m - hop.give_m)
        return hop_height(hop, standing_m, float(take_off_m), float(landing_m), self.times_s)
