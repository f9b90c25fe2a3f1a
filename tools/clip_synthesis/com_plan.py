"""Computes the path of the centre of mass from the ground reaction forces of a gait.

The vertical force F of each foot has the published shape. Its line of action passes from the centre
of pressure p through the centre of mass, approximately as in people. With the mean height h
Newton's law gives z'' = sum F / m - g and x'' = sum F / m (x - p) / h. The equation of y equals the
equation of x. These equations have exactly one periodic solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis.cycle import PeriodicCurve
from tools.clip_synthesis.foot_plan import Stance
from tools.clip_synthesis.gait_data import Gait

GRAVITY = 9.81  # m/s^2
_SAMPLES = 200  # samples per cycle
_HARMONICS = 16


def vertical_load(gait: Gait, phase: FloatArray) -> FloatArray:
    """Return the vertical force on a foot in body weights at phases since its touch-down.

    The mean over the cycle is 1/2, because two feet carry the body.
    """
    phase = phase % 1.0
    angle = np.pi * (phase / gait.duty - 0.5)
    shape = np.cos(angle) - gait.force_shape * np.cos(3.0 * angle)
    mean = gait.duty * (2.0 / np.pi) * (1.0 + gait.force_shape / 3.0)
    return np.where(phase < gait.duty, shape, 0.0) * (0.5 / mean)


@dataclass(frozen=True, eq=False)
class ComPlan:
    """Centre of mass in m as a function of the phase.

    The right foot touches down at phase 0 and at x = 0. `sway_x`, `sway_y` and `height` are
    periodic. In addition x advances by the stride.
    """

    stride_m: float
    sway_x: PeriodicCurve
    sway_y: PeriodicCurve
    height: PeriodicCurve

    def __call__(self, phase: FloatArray) -> FloatArray:
        """Return the world position (n, 3) at phases (n)."""
        x = self.stride_m * phase + self.sway_x(phase)
        return np.stack((x, self.sway_y(phase), self.height(phase)), axis=-1)


def plan_com(stance: Stance, height_m: float) -> ComPlan:
    """Return the motion of the centre of mass with the mean height `height_m`."""
    gait = stance.gait
    phase = np.arange(_SAMPLES) / _SAMPLES
    load = np.zeros(_SAMPLES)
    moment = np.zeros((_SAMPLES, 2))
    # These steps bear load within the cycle. The left foot mirrors the right foot.
    for touch_down, mirror in ((0.0, 1.0), (0.5, -1.0), (-0.5, -1.0)):
        since = phase - touch_down
        on_ground = (since >= 0.0) & (since < gait.duty)
        share = np.where(on_ground, vertical_load(gait, since), 0.0)
        pressure = stance.pressure_point(np.clip(since, 0.0, gait.duty)) * (1.0, mirror)
        pressure[:, 0] += touch_down * gait.stride_m
        load += share
        moment += share[:, None] * pressure
    stiffness = load * GRAVITY / height_m
    # The deviation d from the steady motion s fulfils d'' - k d = k s - k p.
    force = -moment * (GRAVITY / height_m)
    force[:, 0] += stiffness * gait.stride_m * phase
    sway = _periodic_solution(stiffness, force, gait.period_s)
    bounce = _periodic_integral(GRAVITY * (load - 1.0), gait.period_s)
    return ComPlan(
        stride_m=gait.stride_m,
        sway_x=PeriodicCurve.through(sway[:, 0], _HARMONICS),
        sway_y=PeriodicCurve.through(sway[:, 1], _HARMONICS),
        height=PeriodicCurve.through(height_m + bounce, _HARMONICS),
    )


def _periodic_solution(stiffness: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    """Solve d'' - stiffness d = force (n, d) with period `period_s` by finite differences."""
    n = len(stiffness)
    step = period_s / n
    identity = np.eye(n)
    neighbours = np.roll(identity, 1, axis=0) + np.roll(identity, -1, axis=0)
    second = (neighbours - 2.0 * identity) / step**2
    return np.linalg.solve(second - np.diag(stiffness), force)


def _periodic_integral(acceleration: FloatArray, period_s: float) -> FloatArray:
    """Integrate an acceleration (n) of mean 0 twice to a periodic curve of mean 0."""
    spectrum = np.fft.rfft(acceleration)
    omega = 2.0 * np.pi * np.arange(len(spectrum)) / period_s
    spectrum[1:] /= -(omega[1:] ** 2)
    spectrum[0] = 0.0
    return np.fft.irfft(spectrum, n=len(acceleration))
