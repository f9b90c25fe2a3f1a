"""How high the centre of mass is: as high as the legs allow, smoothly; or thrown up in a hop."""

from __future__ import annotations

import itertools

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.com_plan import GRAVITY
from tools.clip_synthesis.moves.move import Hop

_REACH_S = 0.12  # the height looks this far ahead and back for a leg that is stretched


def highest(hips: FloatArray, ankles: FloatArray, reach_m: FloatArray) -> FloatArray:
    """Return how much (n) in m the body may rise before one of its legs is longer than `reach_m`.

    Args:
        hips: (n, 2, 3) m, both hips.
        ankles: (n, 2, 3) m.
        reach_m: (n), at most so far from hip to ankle.

    Raises:
        ValueError: a foot is out of reach at any height.
    """
    offset = hips - ankles
    square = reach_m[:, None] ** 2 - (offset[..., :2] ** 2).sum(axis=-1)
    if square.min() < 0.0:
        frame = int(square.min(axis=1).argmin())
        aside = np.sqrt(reach_m[frame] ** 2 - square.min())
        raise ValueError(
            f"frame {frame}: a foot is {aside:.2f} m beside its hip, the leg is "
            f"{reach_m[frame]:.2f} m long; make the steps shorter"
        )
    return (np.sqrt(square) - offset[..., 2]).min(axis=1)


def smooth_below(bound: FloatArray, step_s: float) -> FloatArray:
    """Return a smooth curve (n) that is nowhere above `bound` (n), values `step_s` apart.

    The lowest value nearby, then a mean over the same reach with weights like a bell.
    """
    reach = round(_REACH_S / step_s)
    padded = np.pad(bound, 2 * reach, mode="edge")
    lowest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).min(axis=1)
    weights = np.hanning(2 * reach + 3)[1:-1]
    return np.convolve(lowest, weights / weights.sum(), mode="valid")


def hop_height(
    hop: Hop, standing_m: float, take_off_m: float, landing_m: float, times_s: FloatArray
) -> FloatArray:
    """Return the height (n) of the centre of mass in a jump, at times (n).

    Polynomials of degree 5 join standing, lowest point, and the free fall between take-off and
    landing, which fixes height, speed and acceleration there.

    Args:
        hop: the jump.
        standing_m: height in standing.
        take_off_m: height as the feet leave the ground.
        landing_m: height as they meet it.
        times_s: (n).
    """
    landing_s = hop.take_off_s + hop.flight_s
    # Upward at the lowest points, as much as an even sweep to and from there takes.
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

    Between two knots the one polynomial of degree 5 that meets both; constant outside.
    """
    values = np.where(times_s < knots[0][0], knots[0][1], knots[-1][1]).astype(np.float64)
    for (t0, *start), (t1, *end) in itertools.pairwise(knots):
        here = (times_s >= t0) & (times_s <= t1)
        span = t1 - t0
        u = (times_s[here] - t0) / span
        low = np.array([start[0], start[1] * span, 0.5 * start[2] * span**2])
        rest = np.array([end[0], end[1] * span, end[2] * span**2])
        rest -= (low.sum(), low[1] + 2.0 * low[2], 2.0 * low[2])
        # u^3, u^4, u^5 take the values `rest` of value, rate and acceleration at u = 1.
        high = np.linalg.solve([[1.0, 1.0, 1.0], [3.0, 4.0, 5.0], [6.0, 12.0, 20.0]], rest)
        values[here] = np.polyval([*high[::-1], *low[::-1]], u)
    return values
