"""Integrates the velocity profile of a move to the body's path over the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.cycle import smoothstep
from tools.clip_synthesis.moves.move import Knots

_STEP_S = 1.0 / 480.0


def ease(knots: Knots, times_s: FloatArray) -> FloatArray:
    """Interpolate knots (time_s, d values) at times (n); return the values (n, d).

    The values follow 3 u^2 - 2 u^3 between two knots, and their rate is 0 at the knots. They are
    constant before the first and after the last knot.
    """
    table = np.asarray(knots, dtype=np.float64)
    place = np.interp(times_s, table[:, 0], np.arange(len(table)))
    row = np.minimum(place.astype(int), max(len(table) - 2, 0))
    rise = smoothstep((place - row)[:, None])
    after = table[np.minimum(row + 1, len(table) - 1), 1:]
    return table[row, 1:] * (1.0 - rise) + after * rise


@dataclass(frozen=True, eq=False)
class Path:
    """Positions (x, y in m) and headings (rad) over time, constant before and after it.

    Attributes:
        times_s: (n).
        places: (n, 3), x, y and yaw; the yaw is not wrapped.
    """

    times_s: FloatArray
    places: FloatArray

    def __call__(self, times_s: FloatArray | float) -> FloatArray:
        """Return x, y, yaw (..., 3) at times of any shape."""
        columns = [np.interp(times_s, self.times_s, column) for column in self.places.T]
        return np.stack(columns, axis=-1)


def follow(profile: Knots, end_s: float) -> Path:
    """Integrate the velocity profile `Move.path` from (0, 0, 0) at time 0 until `end_s`."""
    times_s = np.arange(0.0, end_s + _STEP_S, _STEP_S)
    forward, left, turn = ease(profile, times_s).T
    yaw = _integral(np.radians(turn))
    x = _integral(forward * np.cos(yaw) - left * np.sin(yaw))
    y = _integral(forward * np.sin(yaw) + left * np.cos(yaw))
    return Path(times_s, np.stack((x, y, yaw), axis=-1))


def _integral(rate: FloatArray) -> FloatArray:
    """Integrate a rate (n) from 0 by trapezoids."""
    return np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1])) * _STEP_S))
