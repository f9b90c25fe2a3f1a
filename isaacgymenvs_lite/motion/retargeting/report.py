"""What a retargeting leaves: errors in metres, feet in the ground, sliding, joints at limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.contacts import Flags

KEY_BODIES = ("pelvis", "head", "right_hand", "left_hand", "right_foot", "left_foot")
_ON_GROUND_M = 0.01  # a point of a sole below this height should not move


@dataclass(frozen=True)
class RetargetReport:
    """Figures of a retargeted motion.

    Attributes:
        scale: the figure's leg length divided by the source's.
        errors_m: mean and largest distance in m of the key bodies from the scaled source, by the
            humanoid's names.
        deepest_m: how far a point of a sole is below the ground at most, 0 or more.
        slide_m_s: median and largest horizontal speed of points of the soles in contact; None: no
            foot rests on the ground.
        limited: (share of the frames, joint) of the joint that is at its limit most often; None:
            none ever is.
        fastest_rad_s: the largest speed of a joint.
    """

    scale: float
    errors_m: Mapping[str, tuple[float, float]]
    deepest_m: float
    slide_m_s: tuple[float, float] | None
    limited: tuple[float, str] | None
    fastest_rad_s: float

    @property
    def mean_error_m(self) -> float:
        """The mean over the key bodies of their mean distances in m."""
        return float(np.mean([mean for mean, _ in self.errors_m.values()]))

    @property
    def max_error_m(self) -> float:
        """The largest distance in m of a key body."""
        return max(largest for _, largest in self.errors_m.values())

    def lines(self) -> list[str]:
        """Return two lines for a log."""
        bodies = ", ".join(
            f"{body} {mean:.4f} ({largest:.4f})" for body, (mean, largest) in self.errors_m.items()
        )
        sliding = "they never rest on it"
        if self.slide_m_s is not None:
            sliding = "where they rest on it they slide at {:.3f} m/s (median {:.3f})".format(
                *reversed(self.slide_m_s)
            )
        limited = "no joint is ever at its limit"
        if self.limited is not None:
            limited = "{1} is at its limit in {0:.0%} of the frames, no joint more often".format(
                *self.limited
            )
        return [
            f"scaled by {self.scale:.3f}, the length of the legs; m from the scaled source on "
            f"average (at most): {bodies}",
            f"feet {self.deepest_m:.4f} m below the ground at most; {sliding}; {limited}, the "
            f"fastest moves at {self.fastest_rad_s:.1f} rad/s",
        ]


def most_limited(at_limit: Flags, names: Sequence[str]) -> tuple[float, str] | None:
    """Return the share of the frames, and the joint that is at its limit most often, or None.

    Args:
        at_limit: (T, D).
        names: of the D joints.
    """
    shares = at_limit.mean(axis=0)
    joint = int(shares.argmax()) if len(shares) else 0
    return (float(shares[joint]), names[joint]) if at_limit.any() else None


def summed_up(errors: FloatArray) -> tuple[float, float]:
    """Return mean and largest of errors (T,)."""
    return float(errors.mean()), float(errors.max())


def deepest(points: FloatArray) -> float:
    """Return how far points (..., 3) m are below the ground at most, 0 or more."""
    return max(0.0, -float(points[..., 2].min()))


def sliding_speeds(points: FloatArray, fps: float, contact: Flags) -> tuple[float, float] | None:
    """Return the median and the largest horizontal speed in m/s of points in contact.

    Args:
        points: (T, ..., 3) m, of the soles.
        fps: frames per second.
        contact: (T, ...), which points rest on the ground in the source; a foot that swings close
            above the ground does not rest. Points 1 cm above the ground or higher do not count.

    Returns:
        None if no point rests.
    """
    speed = np.linalg.norm(np.diff(points[..., :2], axis=0), axis=-1) * fps
    touching = contact & (points[..., 2] < _ON_GROUND_M)
    sliding = speed[touching[1:] & touching[:-1]]
    return (float(np.median(sliding)), float(sliding.max())) if sliding.size else None
