"""A foot on the ground: touch-down on the heel, flat sole, roll over the end of the sole.

The part of the sole that touches the ground stays where it is, so the foot cannot skate: while the
toes are up the foot turns about the back edge of its sole, while they are down about the front one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.cycle import smoothstep
from tools.clip_synthesis.gait_data import Gait
from tools.clip_synthesis.leg import Leg


@dataclass(frozen=True)
class Stance:
    """The pose of the right foot on the ground, from touch-down until `gait.duty` of a cycle later.

    A pose is (x, y, z, pitch): the position of the ankle in m and the angle of the foot to the
    ground in rad, toes up positive. x = 0 is below the ankle when the sole lies flat, y = 0 is the
    line of travel.
    """

    gait: Gait
    leg: Leg

    @property
    def yaw(self) -> float:
        """The direction of the right foot about z in rad."""
        return -float(np.radians(self.gait.toe_out_deg))

    def pitch(self, phase: FloatArray) -> FloatArray:
        """Return the pitch (n) in rad at phases (n) in [0, duty]."""
        gait = self.gait
        strike, toe_off = np.radians((gait.strike_pitch_deg, gait.toe_off_pitch_deg))
        roll = np.clip((phase - gait.heel_off) / (gait.duty - gait.heel_off), 0.0, 1.0)
        return strike * (1.0 - smoothstep(phase / gait.foot_flat)) + toe_off * roll * roll

    def pose(self, phase: FloatArray) -> FloatArray:
        """Return the poses (n, 4) at phases (n) in [0, duty]."""
        pitch = self.pitch(phase)
        along, up = self.leg.rolled(pitch).T
        x, y = self._place(along)
        return np.stack((x, y, up, pitch), axis=-1)

    def pressure_point(self, phase: FloatArray) -> FloatArray:
        """Return the centre of pressure (n, 2) at phases (n) in [0, duty].

        It stays on the edge that the foot turns about, and travels over the sole while that is
        flat.
        """
        travel = (phase - self.gait.foot_flat) / (self.gait.heel_off - self.gait.foot_flat)
        along = np.clip(travel, 0.0, 1.0) * (self.leg.heel_m + self.leg.toe_m) - self.leg.heel_m
        return np.stack(self._place(along), axis=-1)

    def _place(self, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y of points at a distance (n) from the flat ankle along the foot."""
        line = -0.5 * self.gait.step_width_m
        return along * np.cos(self.yaw), line + along * np.sin(self.yaw)
