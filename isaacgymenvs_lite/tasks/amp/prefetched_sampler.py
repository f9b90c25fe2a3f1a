"""Random rows that are drawn in blocks and returned a few at a time."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

Rows = tuple[Tensor, ...]


class PrefetchedSampler:
    """A store of independent random rows.

    For the few environments that a step resets, the call itself is the cost: drawing a thousand
    starts takes as long as drawing fifty ten times.

    Args:
        draw: returns n independent rows, tensors (n, ...).
        block: rows to draw at a time, at least 1.
    """

    def __init__(self, draw: Callable[[int], Rows], block: int) -> None:
        self._draw = draw
        self._block = block
        self.clear()

    def clear(self) -> None:
        """Drop the rows that are left; the next ones depend on the generator's current state."""
        self._rows: Rows = ()
        self._left = 0

    def next(self, n: int) -> Rows:
        """Return n rows that were not returned before.

        What is left of a block that is too small is dropped: rows are independent of each other.
        """
        if n > self._block:
            return self._draw(n)
        if n > self._left:
            self._rows = self._draw(self._block)
            self._left = self._block
        first = self._block - self._left
        self._left -= n
        return tuple(rows[first : first + n] for rows in self._rows)
