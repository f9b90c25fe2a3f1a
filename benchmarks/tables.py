"""Writes Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table without a final newline.

    >>> print(markdown(["clip", "tempo"], [["walk", "1.0"]]))
    | clip | tempo |
    |---|---|
    | walk | 1.0 |
    """

    def line(cells: Sequence[str]) -> str:
        return "|" + "".join(f" {cell} |" if cell else " |" for cell in cells)

    return "\n".join([line(headings), "|---" * len(headings) + "|", *map(line, rows)])
