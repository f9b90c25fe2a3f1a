"""Minibatches that divide the samples of an epoch, for any number of environments."""

from __future__ import annotations

import math
from collections.abc import Iterator


def fit_minibatch(batch_size: int, minibatch_size: int, multiple_of: int = 1) -> int:
    """Return the divisor of `batch_size` that is nearest to `minibatch_size` in ratio.

    A minibatch larger than the batch becomes the batch.

    >>> fit_minibatch(1024, 32768)
    1024
    >>> fit_minibatch(1000, 300)  # 250 is 1.2 times smaller, 500 is 1.67 times larger
    250

    Args:
        batch_size: samples of an epoch, at least 1.
        minibatch_size: the wish, at least 1.
        multiple_of: the result is a multiple of this (sequence length of a recurrent network).

    Raises:
        ValueError: `multiple_of` does not divide `batch_size`.
    """
    if batch_size % multiple_of:
        raise ValueError(f"{multiple_of} does not divide the batch of {batch_size}")
    candidates = [divisor for divisor in _divisors(batch_size) if divisor % multiple_of == 0]
    return min(candidates, key=lambda d: max(d, minibatch_size) / min(d, minibatch_size))


def _divisors(number: int) -> Iterator[int]:
    for divisor in range(1, math.isqrt(number) + 1):
        if number % divisor == 0:
            yield divisor
            yield number // divisor
