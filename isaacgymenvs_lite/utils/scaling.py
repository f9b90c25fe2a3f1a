"""Numbers in ranges, and as shares of them."""

from __future__ import annotations

from torch import Tensor


def scale(shares: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return shares (..., D), -1 for lower (D,) and 1 for upper (D,), as values."""
    return 0.5 * (shares + 1.0) * (upper - lower) + lower


def unscale(values: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return values (..., D) with lower (D,) as -1 and upper (D,) as 1."""
    return (2.0 * values - (upper + lower)) / (upper - lower)
