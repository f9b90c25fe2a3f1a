from __future__ import annotations

import torch

from isaacgymenvs_lite.tasks.amp.prefetched_sampler import PrefetchedSampler


class Counter:
    """Draws 0, 1, 2, ... and twice that."""

    def __init__(self) -> None:
        self.calls: list[int] = []
        self._next = 0

    def __call__(self, n: int) -> tuple[torch.Tensor, torch.Tensor]:
        self.calls.append(n)
        rows = torch.arange(self._next, self._next + n)
        self._next += n
        return rows, 2 * rows


def test_no_row_is_returned_twice_and_rows_stay_together():
    draw = Counter()
    store = PrefetchedSampler(draw, block=10)
    taken = [store.next(n) for n in (3, 4, 3, 5, 6, 1)]
    first = torch.cat([rows for rows, _ in taken])
    assert len(first.unique()) == len(first) == 22
    assert torch.equal(torch.cat([rows for _, rows in taken]), 2 * first)
    # 10 rows for 3 + 4 + 3, 10 for the 5, and new ones for the 6 and the 1 behind it
    assert draw.calls == [10, 10, 10]


def test_more_than_a_block_is_drawn_at_once():
    draw = Counter()
    store = PrefetchedSampler(draw, block=4)
    store.next(2)
    assert len(store.next(9)[0]) == 9
    assert draw.calls == [4, 9]
    assert store.next(2)[0].tolist() == [2, 3]


def test_after_clear_nothing_drawn_before_is_returned():
    store = PrefetchedSampler(Counter(), block=4)
    store.next(1)
    store.clear()
    assert store.next(2)[0].tolist() == [4, 5]
