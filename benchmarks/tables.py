"""Markdown tables, as docs/ has them and a terminal shows them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, without a line end.

    >>> print(markdown(["clip", "tempo"], [["walk", "1.0"]]))
    | clip | tempo |
    |---|---|
    | walk | 1.0 |
    """
    lines = [_line(headings), "|---" * len(headings) + "|", *map(_line, rows)]
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "|" + "".join(f" {cell} |" if cell else " |" for cell in cells)
