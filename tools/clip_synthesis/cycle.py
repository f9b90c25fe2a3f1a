"""Fits short Fourier series to tables over the gait cycle, and evaluates cubic polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.motion.kinematics import FloatArray

# 99.7 % of the power of gait curves is below 6 Hz (Winter). Fewer harmonics than 10, half of the 20
# table values, also smooth the rounding to whole degrees.
_HARMONICS = 6


@dataclass(frozen=True, eq=False)
class PeriodicCurve:
    """A curve of period 1: the real part of sum_k c_k exp(2 pi i k phase), k = 0, 1, ..."""

    coefficients: npt.NDArray[np.complex128]

    @classmethod
    def through(
        cls, samples: Sequence[float] | FloatArray, harmonics: int = _HARMONICS
    ) -> PeriodicCurve:
        """Fit `harmonics` harmonics (least squares) to samples at evenly spaced phases from 0."""
        values = np.asarray(samples, dtype=np.float64)
        coefficients = np.fft.rfft(values) / len(values)
        coefficients[1:] *= 2.0
        return cls(coefficients[: harmonics + 1])

    @classmethod
    def from_degrees(cls, table: Sequence[float]) -> PeriodicCurve:
        """Return the curve in rad for a full-cycle table in degrees."""
        return cls.through(np.radians(np.asarray(table, dtype=np.float64)))

    @classmethod
    def odd(cls, half_table: Sequence[float]) -> PeriodicCurve:
        """Return the curve in rad for a half-cycle table in degrees; the other half is negated."""
        return cls.from_degrees([*half_table, *(-value for value in half_table)])

    @classmethod
    def even(cls, half_table: Sequence[float]) -> PeriodicCurve:
        """Return the curve in rad for a half-cycle table in degrees; the other half is equal."""
        return cls.from_degrees([*half_table, *half_table])

    def __call__(self, phase: FloatArray | float) -> FloatArray:
        """Return the values at phases of any shape."""
        turns = 2.0j * np.pi * np.arange(len(self.coefficients))
        angles = np.asarray(phase, dtype=np.float64)[..., None] * turns
        return (np.exp(angles) @ self.coefficients).real


def smoothstep(u: FloatArray | float) -> FloatArray:
    """Return 3 u^2 - 2 u^3, which is 0 below u = 0 and 1 above u = 1."""
    u = np.clip(u, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


def hermite(
    start: tuple[FloatArray, FloatArray],
    end: tuple[FloatArray, FloatArray],
    span: float,
    u: FloatArray,
) -> FloatArray:
    """Return the values (n, d) of a cubic polynomial at u (n) in [0, 1].

    Args:
        start: value (d) and rate (d) at u = 0. Rates are derivatives by the time u * span.
        end: value (d) and rate (d) at u = 1.
        span: length of the interval.
        u: relative positions (n).
    """
    u = u[:, None]
    rise = smoothstep(u)
    start_slope = u * (1.0 - u) ** 2 * span
    end_slope = u * u * (u - 1.0) * span
    return (1.0 - rise) * start[0] + rise * end[0] + start_slope * start[1] + end_slope * end[1]
