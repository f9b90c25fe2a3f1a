"""Histories: what the last control steps gave, the newest first."""

from __future__ import annotations

from torch import Tensor


def push_newest(history: Tensor, newest: Tensor) -> None:
    """Put values (N, ...) first into a history (N, H, ...), in place; the oldest ones drop out."""
    for age in range(history.shape[1] - 1, 0, -1):
        history[:, age] = history[:, age - 1]
    history[:, 0] = newest
