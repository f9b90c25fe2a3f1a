"""Rewards as terms by name, whose sum is the reward."""

from __future__ import annotations

import torch
from torch import Tensor

Terms = dict[str, Tensor]


def replace_where(terms: Terms, where: Tensor, name: str, value: float) -> Terms:
    """Return the terms, but in environments `where` (N,) bool only one, `name`, of this value."""
    replaced = {key: term.masked_fill(where, 0.0) for key, term in terms.items()}
    replaced[name] = torch.zeros_like(next(iter(terms.values()))).masked_fill_(where, value)
    return replaced


def total(terms: Terms) -> Tensor:
    """Return the sum (N,) of the terms (N,)."""
    values = tuple(terms.values())
    return values[0] if len(values) == 1 else torch.stack(values).sum(0)
