"""The path of the centre of mass over the feet, by Newton's law.

The force passes from the centre of pressure p to the centre of mass, so that
x'' = (g + z'') / z (x - p), and the same for y (the linear inverted pendulum of Kajita et al., ICRA
2003, with a height z that may change). In flight g + z'' = 0 and x'' = 0. What the limbs do besides
turns the body; its rate of angular momentum, where known, shifts p.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_banded

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.com_plan import GRAVITY
from tools.clip_synthesis.moves.contacts import FootTrack

_NO_LOAD = 1e-9


def pressure_path(tracks: tuple[FootTrack, FootTrack], times_s: FloatArray) -> FloatArray:
    """Return the planned centre of pressure (n, 2) m of both feet at times (n).

    Where no foot carries anything it goes straight from the last to the next place.
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
    shift: FloatArray | None = None,
) -> FloatArray:
    """Return the horizontal path (n, 2) m of the centre of mass, at rest over p at both ends.

    Args:
        pressure: (n, 2) m, centre of pressure, `step_s` apart.
        height_m: (n), height of the centre of mass.
        acceleration: (n) m/s^2, its vertical acceleration.
        step_s: time step.
        shift: (n, 2) m^2/s^2, the rate of angular momentum per mass as it shifts p times the
            vertical force per mass: (L_y', -L_x') / m.
    """
    force = np.maximum(GRAVITY + acceleration, 0.0)
    stiffness = (force / height_m)[1:-1]
    demand = pressure * force[:, None]
    if shift is not None:
        # Nothing but the ground can turn the body: what is asked for in flight is left out.
        demand = demand + shift * np.minimum(force / GRAVITY, 1.0)[:, None]
    # (x[i-1] - 2 x[i] + x[i+1]) / step^2 - k x[i] = -demand / z, x = p at both ends.
    n = len(pressure)
    bands = np.zeros((3, n))
    bands[0, 2:] = bands[2, :-2] = 1.0 / step_s**2
    bands[1] = 1.0
    bands[1, 1:-1] = -2.0 / step_s**2 - stiffness
    right = pressure.copy()
    right[1:-1] = -(demand / height_m[:, None])[1:-1]
    return solve_banded((1, 1), bands, right)
