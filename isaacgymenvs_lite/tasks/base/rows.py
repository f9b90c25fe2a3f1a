"""Observations as rows with one value for each environment.

The tensors of the backend keep each component of all environments together. Rows are joined and
scaled in contiguous memory, several times as fast as columns.
"""

from __future__ import annotations

import torch
from torch import Tensor


def body_rows(bodies: Tensor, *values: Tensor) -> Tensor:
    """Return the values of K bodies as rows (K c, N), body after body.

    Args:
        bodies: (K,) ids of bodies.
        values: tensors (N, B, c_i) of the backend, whose c values in all are joined for each body.
    """
    parts = [value.permute(2, 1, 0).index_select(1, bodies) for value in values]
    return torch.cat(parts).transpose(0, 1).flatten(0, 1)


def dof_rows(dofs: Tensor, values: Tensor) -> Tensor:
    """Return the values (N, D) of the degrees of freedom `dofs` (k,) as rows (k, N)."""
    return values.t().index_select(0, dofs)
