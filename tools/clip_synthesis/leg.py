"""Describes the humanoid's leg by dimensions, and by angles in the plane of hip, knee and ankle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton


@dataclass(frozen=True)
class Leg:
    """Lengths of a leg in m. The foot is rigid and its sole is flat.

    Attributes:
        thigh_m: from the hip to the knee.
        shin_m: from the knee to the ankle.
        ankle_height_m: height of the ankle over the sole.
        heel_m: from the ankle back to the end of the sole.
        toe_m: from the ankle forward to the end of the sole.
    """

    thigh_m: float
    shin_m: float
    ankle_height_m: float
    heel_m: float
    toe_m: float

    @classmethod
    def from_skeleton(cls, skeleton: Skeleton) -> Leg:
        """Read the right leg; the left leg is its mirror image."""
        foot = skeleton.body_names.index("right_foot")
        shin = skeleton.body_names.index("right_shin")
        corners = skeleton.foot_corners[[body == foot for body in skeleton.foot_body_ids]]
        return cls(
            thigh_m=-float(skeleton.local_translation[shin, 2]),
            shin_m=-float(skeleton.local_translation[foot, 2]),
            ankle_height_m=-float(corners[:, 2].min()),
            heel_m=-float(corners[:, 0].min()),
            toe_m=float(corners[:, 0].max()),
        )

    def ankle(self, thigh: FloatArray, knee: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the distances in m by which the ankle is ahead of and below the hip.

        Args:
            thigh: angle of the thigh to the vertical in rad, forward positive.
            knee: flexion in rad.
        """
        shin = thigh - knee
        ahead = self.thigh_m * np.sin(thigh) + self.shin_m * np.sin(shin)
        below = self.thigh_m * np.cos(thigh) + self.shin_m * np.cos(shin)
        return ahead, below

    def angles(self, ahead: FloatArray, below: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return thigh and knee angles in rad; the inverse of `ankle`, straight if out of reach."""
        reach = np.hypot(ahead, below)
        links = 2.0 * self.thigh_m * self.shin_m
        cos_knee = (reach**2 - self.thigh_m**2 - self.shin_m**2) / links
        knee = np.arccos(np.clip(cos_knee, -1.0, 1.0))
        thigh = np.arctan2(ahead, below) + np.arctan2(
            self.shin_m * np.sin(knee), self.thigh_m + self.shin_m * np.cos(knee)
        )
        return thigh, knee

    def reach(self, knee: FloatArray) -> FloatArray:
        """Return the distances (n) in m from hip to ankle for knee flexions (n) in rad."""
        return np.hypot(*self.ankle(np.zeros_like(knee), knee))

    def rolled(self, pitch: FloatArray, rounding_m: FloatArray | float = 0.0) -> FloatArray:
        """Return the position of the ankle (n, 2) in m for a foot on an edge of its sole.

        The first column is the distance ahead of the position with a flat sole. The second column
        is the height. The foot stands on the back edge with the toes up, else on the front edge.

        Args:
            pitch: (n) rad, angle of the foot to the ground, toes up positive.
            rounding_m: radius of the edges, 0 for sharp edges. A swinging foot needs some cm, which
                make the change from one edge to the other smooth.
        """
        pivot = np.where(pitch > 0.0, -self.heel_m, self.toe_m)
        cos, sin = np.cos(pitch), np.sin(pitch)
        ahead = pivot - pivot * cos - self.ankle_height_m * sin
        # The height of the ankle over the lower edge is the larger of -toe sin and heel sin.
        mean, half = 0.5 * (self.heel_m - self.toe_m) * sin, 0.5 * (self.heel_m + self.toe_m) * sin
        up = mean + np.hypot(half, rounding_m) + self.ankle_height_m * cos
        return np.stack((ahead, up), axis=-1)
