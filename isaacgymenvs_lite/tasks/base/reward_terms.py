"""Named reward terms, whose sum is the reward."""

from __future__ import annotations

import torch
from torch import Tensor

Terms = dict[str, Tensor]


def replace_where(terms: Terms, where: Tensor, name: str, value: float) -> Terms:
    """Replace all terms by one term `name` with this value in the environments `where` (N,)."""
    kept = torch.stack(tuple(terms.values())).masked_fill_(where, 0.0)
    return {**dict(zip(terms, kept, strict=True)), name: where * value}


def total(terms: Terms) -> Tensor:
    """Return the sum (N,) of terms (N,)."""
    return torch.stack(tuple(terms.values())).sum(0)
