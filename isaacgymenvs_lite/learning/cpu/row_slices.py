"""Cutting tensors of rows into slices, and putting together what was made of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

# Rows that are evaluated at once: the activations of as many fit into the cache.
_CHUNK_ROWS = 8192


def evaluate_in_chunks(function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
    """Return float32 function(*rows), (..., D), of rows (..., F) each, without gradients.

    Not all rows at once, so that activations stay in the cache.

    Args:
        function: (n, F) of each -> (n, D), each row for itself.
        rows: of any number of leading dimensions, the same ones.
    """
    with torch.no_grad():
        columns = [x.reshape(-1, x.shape[-1]).split(_CHUNK_ROWS) for x in rows]
        results = torch.cat([function(*chunk).float() for chunk in zip(*columns, strict=True)])
    return results.view(*rows[0].shape[:-1], -1)


def split_rows(rows: tuple[Tensor, ...], slices: int) -> list[tuple[Tensor, ...]]:
    """Return `slices` tuples of consecutive parts of all tensors."""
    return list(zip(*(torch.tensor_split(tensor, slices) for tensor in rows), strict=True))


def split_proportionally(
    rows: dict[str, Tensor], slices: int
) -> tuple[list[dict[str, Tensor]], list[float]]:
    """Cut tensors of different lengths so that each slice has the same share of all of them.

    Means over the slices, weighted by the shares, are then means over all rows of each tensor.

    Args:
        rows: {name: (n, ...)}, not empty.
        slices: at most so many; there are fewer if the lengths have no common divisor that large.

    Returns:
        The slices, consecutive rows, and their shares, which add up to 1.
    """
    unit = math.gcd(*(len(tensor) for tensor in rows.values()))
    slices = max(1, min(slices, unit))
    ends = [unit * i // slices for i in range(slices + 1)]
    parts = [
        {name: t[len(t) // unit * first : len(t) // unit * end] for name, t in rows.items()}
        for first, end in itertools.pairwise(ends)
    ]
    return parts, [(end - first) / unit for first, end in itertools.pairwise(ends)]


def join(values: list[Tensor], shares: list[float]) -> Tensor:
    """Put the values of slices together: the mean of numbers, all rows of rows."""
    if values[0].ndim > 0:
        return torch.cat(values)
    return torch.stack([v * share for v, share in zip(values, shares, strict=True)]).sum()


def sum_of_slices(grads: tuple[Tensor | None, ...]) -> Tensor | None:
    """Add a parameter's gradients in the order of the slices."""
    total = grads[0]
    for grad in grads[1:]:
        total = grad if total is None else total if grad is None else total + grad
    return total
