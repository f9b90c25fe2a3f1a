"""Random values for tasks."""

from __future__ import annotations

import torch
from torch import Tensor


def uniform(env_ids: Tensor, low: float, high: float, size: tuple[int, ...] = ()) -> Tensor:
    """Return uniform random values (n, *size) in [low, high) for environments (n,)."""
    return low + (high - low) * torch.rand(len(env_ids), *size, device=env_ids.device)
