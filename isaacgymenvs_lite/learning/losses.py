"""Advantages that are normalised, and gradients for penalties."""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.distributed.moments import normalize_jointly


def input_gradient(outputs: Tensor, inputs: Tensor) -> Tensor:
    """Return (K, F) the gradients of outputs (K, 1) by inputs (K, F), differentiable themselves.

    For gradient penalties; each output depends on the input of its own row only.
    """
    (gradient,) = torch.autograd.grad(outputs, inputs, torch.ones_like(outputs), create_graph=True)
    return gradient


def normalize_advantages(advantages: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return advantages (n,) normalised by mean and standard deviation of the rows that count.

    Of several processes that train together the rows of all count.

    Args:
        advantages: of this process.
        mask: (n,) 1 where a row counts; None: all do.
    """
    if current_group().size > 1:
        return normalize_jointly(advantages, torch.ones_like(advantages) if mask is None else mask)
    if mask is not None:
        return normalize_masked(advantages, mask)
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def normalize_masked(values: Tensor, mask: Tensor) -> Tensor:
    """Return values (n,) normalised by mean and standard deviation of the rows of mask (n,) 1.

    The variance is unbiased; with fewer than two such rows the values are returned unchanged.
    """
    count = mask.sum()
    if count < 2:
        return values
    mean = (mask * values).sum() / count
    variance = ((mask * values).square().sum() / count - mean.square()) * count / (count - 1)
    return (values - mean) / (variance.clamp(min=0.0).sqrt() + 1e-8)
