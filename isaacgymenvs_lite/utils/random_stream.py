"""Provides a random stream of one environment, independent of the rest of the process."""

from __future__ import annotations

from types import TracebackType

import torch
from torch import Tensor


class RandomStream:
    """Switches torch's CPU generator to the state of an environment, in a `with` statement.

    Tasks and agents draw from the same generator of torch, but seeding an environment must not make
    the agent repeat its noise. Without a seed the environment uses the state of the process.
    Switching the state takes about a microsecond.
    """

    def __init__(self) -> None:
        self._own: Tensor | None = None
        self._others: Tensor | None = None

    def seed(self, seed: int) -> None:
        """Start the random sequence of the environment from a seed."""
        self._own = torch.Generator().manual_seed(seed).get_state()

    def __enter__(self) -> RandomStream:
        if self._own is not None:
            self._others = torch.get_rng_state()
            torch.set_rng_state(self._own)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._others is not None:
            self._own = torch.get_rng_state()
            torch.set_rng_state(self._others)
            self._others = None
