"""Observations as rows with one value for each environment.

Row i has component i of all environments, as the backend stores its state. Joining and scaling rows
is several times as fast as joining and scaling columns.
"""

from __future__ import annotations

import torch
from torch import Tensor


def body_rows(bodies: Tensor, *values: Tensor) -> Tensor:
    """Return the values of K bodies as rows (K c, N), body after body.

    Args:
        bodies: (K,) ids of bodies.
        values: tensors (N, B, c_i) of the backend; c is the sum of all c_i.
    """
    parts = [value.permute(2, 1, 0).index_select(1, bodies) for value in values]
    return torch.cat(parts).transpose(0, 1).flatten(0, 1)


def dof_rows(dofs: Tensor, values: Tensor) -> Tensor:
    """Return the values (N, D) of the degrees of freedom `dofs` (k,) as rows (k, N)."""
    return values.t().index_select(0, dofs)
