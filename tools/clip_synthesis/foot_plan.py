"""Where the feet are at every phase of a gait: fixed on the ground, or swinging forward."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.cycle import PeriodicCurve, hermite
from tools.clip_synthesis.stance import Stance

_EARLY = 0.75  # below 1: the extra lift of the foot comes before the middle of the swing
_RATE_STEP = 1e-4  # of a cycle, for numerical rates


@dataclass(frozen=True, eq=False)
class FootPlan:
    """The path of the right ankle and the attitude of the foot; the left one mirrors it.

    The swing follows the published angles of thigh, knee and foot, plus a cubic correction of each
    that joins it to the angles that the stances before and after it ask for. So the leg is never
    asked to reach further than it can.

    Attributes:
        stance: the foot on the ground.
        right_hip: world position (n, 3) in m of the right hip at phases (n).
    """

    stance: Stance
    right_hip: Callable[[FloatArray], FloatArray]

    def poses(self, phase: FloatArray, side: float) -> FloatArray:
        """Return (x, y, z, pitch), (n, 4), of a foot at phases (n) of the gait.

        As `Stance.pose`; the right foot (side -1) touches down at phase 0 at x = 0, the left one
        half a cycle later and half a stride further.
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
        """Return thigh, knee and foot pitch (n) in rad of a leg at phases (n), in its plane.

        Thigh and foot are measured to the vertical and to the ground, positive forward and up.
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
        """Return values and rates (2, 4) to add to the published angles at toe-off and touch-down.

        The swing takes over the rates of the stance. It does not hand its own over to the next
        stance: the leg meets the ground while the thigh moves back at the rate of the gait.
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
        """Return (thigh, knee, pitch, y), (n, 4), of foot poses (n, 4) at phases (n)."""
        offset = poses[:, :3] - self.right_hip(phase)
        thigh, knee = self.stance.leg.angles(offset[:, 0], np.hypot(offset[:, 1], offset[:, 2]))
        return np.stack((thigh, knee, poses[:, 3], poses[:, 1]), axis=-1)

    def _published_angles(self, phase: FloatArray) -> FloatArray:
        """Return (thigh, knee, pitch, 0), (n, 4): angles to the vertical and to the ground."""
        gait = self.stance.gait
        thigh = PeriodicCurve.from_degrees(gait.hip_flexion)(phase)
        thigh = thigh - PeriodicCurve.even(gait.pelvis_tilt)(phase)
        knee = PeriodicCurve.from_degrees(gait.knee_flexion)(phase)
        pitch = thigh - knee + PeriodicCurve.from_degrees(gait.ankle_dorsiflexion)(phase)
        return np.stack((thigh, knee, pitch, np.zeros_like(phase)), axis=-1)
