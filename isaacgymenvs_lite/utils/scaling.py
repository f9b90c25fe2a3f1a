"""Converts values between ranges with given limits and the range from -1 to 1."""

from __future__ import annotations

from torch import Tensor


def scale(shares: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Map shares (..., D) from [-1, 1] to [lower, upper], both (D,)."""
    return 0.5 * (shares + 1.0) * (upper - lower) + lower


def unscale(values: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Map values (..., D) from [lower, upper], both (D,), to [-1, 1]."""
    return (2.0 * values - (upper + lower)) / (upper - lower)
