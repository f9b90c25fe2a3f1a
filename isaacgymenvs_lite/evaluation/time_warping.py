"""Aligns many episodes with a reference at once, by subsequence dynamic time warping.

References:
    Müller, "Information Retrieval for Music and Motion", 2007, chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

# What a path cell and a step in the reference add to the imaginary part of a path's cost.
_CELL = 1.0
_ADVANCE = 2.0**-24


@dataclass(frozen=True, eq=False)
class Alignment:
    """The cheapest warping paths of E episodes.

    Attributes:
        mean_cost: (E,) float64, the cost of the path, with what it pays for its steps, divided by
            the number of its cells.
        advance: (E,) int, reference frames from the first to the last cell of the path.
    """

    mean_cost: npt.NDArray[np.float64]
    advance: npt.NDArray[np.int64]


def align(
    cost: npt.NDArray[np.floating],
    lengths: npt.NDArray[np.integer],
    num_columns: npt.NDArray[np.integer],
    off_tempo: float = 0.0,
) -> Alignment:
    """Align episodes with a reference by subsequence dynamic time warping.

    A path visits cells (t, s), from any cell of an episode's first row to any cell of its last
    row, by the steps (1, 0), (0, 1) and (1, 1). The cheapest path has the smallest sum of costs;
    among equally cheap ones the one with the fewest cells counts, then the one that advances the
    least in the reference. Time is O(E T S), memory beside `cost` O(E T).

    Args:
        cost: (T, S, E), not negative: cost of frame t of episode e at reference frame s.
        lengths: (E,), rows of each episode, 1 to T; the rows after them are ignored.
        num_columns: (E,), columns of each episode, at least 1. More than S repeat the reference
            from its start.
        off_tempo: what a path pays for a step (1, 0) or (0, 1): where all cells cost about the
            same, it goes on by (1, 1).
    """
    num_rows, num_frames, num_episodes = cost.shape
    max_columns = int(num_columns.max())

    # A path's cost and, as the imaginary part, its cells and its advance in one number: numpy
    # orders complex numbers by the real and then by the imaginary part, which is the tie rule.
    # Row 0 is before the episode: every path begins there at no cost. The cells of an
    # anti-diagonal depend only on the two before it, hence three arrays that take turns.
    older, old, new = (np.full((num_rows + 1, num_episodes), np.inf + 0j) for _ in range(3))
    for diagonal in (older, old, new):
        diagonal[0] = 0.0
    best: npt.NDArray[np.complex128] = np.full(num_episodes, np.inf + 0j)
    episodes = np.arange(num_episodes)
    rows = np.arange(num_rows)
    stay = np.full((num_rows, 1), off_tempo)
    stay[0] = 0.0  # a path begins here
    for k in range(num_rows + max_columns - 1):
        first, last = max(0, k - max_columns + 1), min(num_rows, k + 1)
        t = rows[first:last]
        before = np.minimum(old[t + 1] + off_tempo, older[t])  # (t, s - 1) and (t - 1, s - 1)
        before += 1j * _ADVANCE
        np.minimum(before, old[t] + stay[t], out=before)  # (t - 1, s)
        before += cost[t, (k - t) % num_frames]
        before += 1j * _CELL
        new[first + 1 : last + 1] = before

        end_column = k - (lengths - 1)
        ends = episodes[(end_column >= 0) & (end_column < num_columns)]
        best[ends] = np.minimum(best[ends], new[lengths[ends], ends])
        older, old, new = old, new, older

    cells = np.floor(best.imag)
    advance = np.rint((best.imag - cells) / _ADVANCE)
    return Alignment(best.real / cells, advance.astype(np.int64))
