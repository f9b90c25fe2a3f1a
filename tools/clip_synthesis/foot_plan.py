"""Plans the poses of the feet at every phase of a gait, in stance and in swing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.cycle import PeriodicCurve, hermite, smoothstep
from tools.clip_synthesis.gait_data import Gait
from tools.clip_synthesis.leg import Leg

_EARLY = 0.75  # values below 1 shift the extra lift of the foot before the middle of the swing
_RATE_STEP = 1e-4  # phase step of numerical rates


@dataclass(frozen=True)
class Stance:
    """Poses of the right foot on the ground at phases 0 (touch-down) to `gait.duty`.

    The foot lands on the heel, lies flat, and rolls over its front edge. It turns about the back
    edge with the toes up and about the front edge with the toes down, and it does not skate.

    A pose is (x, y, z, pitch). The position of the ankle is in m. The pitch is the angle of the
    foot to the ground in rad, toes up positive. The ankle of the flat foot is at x = 0. The line of
    travel is at y = 0.
    """

    gait: Gait
    leg: Leg

    @property
    def yaw(self) -> float:
        """The direction of the foot about z in rad."""
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
        """Return the centre of pressure (n, 2) in m at phases (n) in [0, duty].

        It travels over the flat sole. Otherwise it stays on the edge about which the foot turns.
        """
        travel = (phase - self.gait.foot_flat) / (self.gait.heel_off - self.gait.foot_flat)
        along = np.clip(travel, 0.0, 1.0) * (self.leg.heel_m + self.leg.toe_m) - self.leg.heel_m
        return np.stack(self._place(along), axis=-1)

    def _place(self, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y of points at distances (n) ahead of the flat foot's ankle."""
        line = -0.5 * self.gait.step_width_m
        return along * np.cos(self.yaw), line + along * np.sin(self.yaw)


@dataclass(frozen=True, eq=False)
class FootPlan:
    """Poses of the right foot over a whole cycle; the left foot mirrors the right foot.

    The swing follows the published angles of thigh, knee and foot. A cubic correction joins each
    angle to the stances before and after the swing. Therefore the foot stays within reach.

    Attributes:
        stance: the foot on the ground.
        right_hip: returns world positions (n, 3) in m of the right hip at phases (n).
    """

    stance: Stance
    right_hip: Callable[[FloatArray], FloatArray]

    def poses(self, phase: FloatArray, side: float) -> FloatArray:
        """Return the poses (n, 4) of a foot at phases (n) of the gait; see `Stance`.

        The right foot (side -1) touches down at phase 0 at x = 0. The left foot (side 1) touches
        down half a cycle later and half a stride ahead.
        """
        gait = self.stance.gait
        late = 0.5 if side > 0.0 else 0.0
        cycles = np.floor(phase - late)
        since = phase - late - cycles
        on_ground = since < gait.duty
        poses = np.empty((len(phase), 4))
        poses[on_ground] = self.stance.pose(since[on_ground])
        poses[~on_ground] = self._swing(since[~on_ground])
        poses[:, 0] += (cycles + late) * gait.stride_m
        poses[:, 1] *= -side
        return poses

    def leg_angles(
        self, phase: FloatArray, side: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return thigh, knee and foot pitch (n) in rad at phases (n) in the plane of the leg.

        The thigh is measured to the vertical, forward positive. The pitch is measured to the
        ground, toes up positive.
        """
        own_phase = phase - (0.5 if side > 0.0 else 0.0)
        thigh, knee, pitch, _ = self._angles_of(self.poses(own_phase, -1.0), own_phase).T
        return thigh, knee, pitch

    def stance_reach(self) -> FloatArray:
        """Return the distances (n) in m from hip to ankle over the stance."""
        phase = np.linspace(0.0, self.stance.gait.duty, 100)
        return np.linalg.norm(self.stance.pose(phase)[:, :3] - self.right_hip(phase), axis=1)

    def _swing(self, since: FloatArray) -> FloatArray:
        gait, leg = self.stance.gait, self.stance.leg
        span = 1.0 - gait.duty
        u = (since - gait.duty) / span
        offset, slope = self._correction_at_ends()
        correction = hermite((offset[0], slope[0]), (offset[1], slope[1]), span, u)
        thigh, knee, pitch, aside = (self._published_angles(since) + correction).T
        bump = np.sin(np.pi * u**_EARLY) ** 2
        ahead, below = leg.ankle(thigh, knee + np.radians(gait.swing_knee_deg) * bump)
        pitch = pitch + np.radians(gait.swing_toe_up_deg) * bump
        aside = aside - gait.swing_out_m * bump
        hip = self.right_hip(since)
        down = np.sqrt(below**2 - (aside - hip[:, 1]) ** 2)
        return np.stack((hip[:, 0] + ahead, aside, hip[:, 2] - down, pitch), axis=-1)

    def _correction_at_ends(self) -> tuple[FloatArray, FloatArray]:
        """Return corrections (2, 4) of the published angles and their rates at both swing ends.

        At toe-off the swing continues the rates of the stance. At touch-down the thigh moves back
        at the gait's retraction rate.
        """
        gait = self.stance.gait
        before = np.array([gait.duty - _RATE_STEP, gait.duty, 0.0])
        poses = self.stance.pose(before)
        phase = np.array([gait.duty - _RATE_STEP, gait.duty, 1.0])
        poses[2, 0] += gait.stride_m
        required = self._angles_of(poses, phase)
        published = self._published_angles(phase)
        steps = self._published_angles(phase + _RATE_STEP) - published
        rates = np.zeros((2, 4))
        rates[0] = (required[1] - required[0] - steps[0]) / _RATE_STEP
        rates[1, 0] = -np.radians(gait.retraction_deg) - steps[2, 0] / _RATE_STEP
        return (required - published)[1:], rates

    def _angles_of(self, poses: FloatArray, phase: FloatArray) -> FloatArray:
        """Return thigh, knee, pitch and y (n, 4) for foot poses (n, 4) at phases (n)."""
        offset = poses[:, :3] - self.right_hip(phase)
        thigh, knee = self.stance.leg.angles(offset[:, 0], np.hypot(offset[:, 1], offset[:, 2]))
        return np.stack((thigh, knee, poses[:, 3], poses[:, 1]), axis=-1)

    def _published_angles(self, phase: FloatArray) -> FloatArray:
        """Return the published thigh, knee and pitch, and 0, as (n, 4); see `leg_angles`."""
        gait = self.stance.gait
        thigh = PeriodicCurve.from_degrees(gait.hip_flexion)(phase)
        thigh = thigh - PeriodicCurve.even(gait.pelvis_tilt)(phase)
        knee = PeriodicCurve.from_degrees(gait.knee_flexion)(phase)
        pitch = thigh - knee + PeriodicCurve.from_degrees(gait.ankle_dorsiflexion)(phase)
        return np.stack((thigh, knee, pitch, np.zeros_like(phase)), axis=-1)
