from __future__ import annotations

from collections import Counter

import pytest
import torch

from isaacgymenvs_lite.learning.replay_buffer import ReplayBuffer


def rows(*numbers: int) -> dict[str, torch.Tensor]:
    """Rows [n, 10 n], to see whether the columns of a row stay together."""
    return {"x": torch.tensor([[n, 10 * n] for n in numbers], dtype=torch.float32).view(-1, 2)}


def content(buffer: ReplayBuffer) -> list[int]:
    """The numbers of the stored rows, sorted."""
    return sorted(int(n) for n in buffer.rows["x"][:, 0])


def test_the_oldest_rows_are_overwritten():
    buffer = ReplayBuffer(5, "cpu")
    buffer.store(rows(0, 1, 2))
    buffer.store(rows(3, 4, 5, 6))
    assert content(buffer) == [2, 3, 4, 5, 6]
    buffer.store(rows(7))
    assert content(buffer) == [3, 4, 5, 6, 7]
    assert buffer.get_total_count() == 8
    assert buffer.get_buffer_size() == 5


def test_of_more_rows_than_fit_the_last_stay():
    buffer = ReplayBuffer(4, "cpu")
    buffer.store(rows(100))
    buffer.store(rows(*range(11)))
    assert content(buffer) == [7, 8, 9, 10]
    assert buffer.get_total_count() == 12
    # the next two rows overwrite the oldest, 7 and 8
    buffer.store(rows(11, 12))
    assert content(buffer) == [9, 10, 11, 12]


@pytest.mark.parametrize(
    "chunks", [(1,) * 23, (3, 5, 2, 9, 4), (6, 6, 6), (13, 1, 6, 7), (7, 0, 8)]
)
def test_any_sequence_of_stores_keeps_the_newest_rows(chunks):
    size, stored = 6, []
    buffer = ReplayBuffer(size, "cpu")
    for chunk in chunks:
        new = list(range(len(stored), len(stored) + chunk))
        buffer.store(rows(*new))
        stored += new
        if len(stored) >= size:
            assert content(buffer) == stored[-size:]
    assert buffer.get_total_count() == len(stored)


def test_storing_nothing_is_legal():
    buffer = ReplayBuffer(3, "cpu")
    buffer.store(rows())
    assert buffer.get_total_count() == 0
    buffer.store(rows(1, 2, 3))
    buffer.store(rows())
    assert content(buffer) == [1, 2, 3]
    assert buffer.get_total_count() == 3


def test_every_row_once_in_a_pass():
    buffer = ReplayBuffer(12, "cpu")
    buffer.store(rows(*range(12)))
    for _ in range(3):
        seen = [int(n) for _ in range(3) for n in buffer.sample(4)["x"][:, 0]]
        assert sorted(seen) == list(range(12))


def test_passes_have_orders_of_their_own():
    torch.manual_seed(0)
    buffer = ReplayBuffer(64, "cpu")
    buffer.store(rows(*range(64)))
    first, second = (buffer.sample(64)["x"][:, 0].tolist() for _ in range(2))
    # equal by chance once in 64! draws
    assert first != second
    assert first != sorted(first)


def test_a_sample_that_passes_the_end_wraps_around_its_own_pass():
    buffer = ReplayBuffer(5, "cpu")
    buffer.store(rows(*range(5)))
    drawn = [int(n) for _ in range(2) for n in buffer.sample(3)["x"][:, 0]]
    assert sorted(drawn[:5]) == list(range(5))
    assert drawn[5] == drawn[0]
    # and then a new pass begins
    assert len({int(n) for n in buffer.sample(5)["x"][:, 0]}) == 5


def test_a_sample_may_be_larger_than_the_buffer():
    buffer = ReplayBuffer(4, "cpu")
    buffer.store(rows(*range(4)))
    counts = Counter(int(n) for n in buffer.sample(10)["x"][:, 0])
    assert sum(counts.values()) == 10
    assert set(counts.values()) == {2, 3}


def test_while_it_fills_indices_are_taken_modulo_the_rows_stored():
    buffer = ReplayBuffer(8, "cpu")
    buffer.store(rows(0, 1, 2))
    counts = Counter(int(n) for n in buffer.sample(8)["x"][:, 0])
    # of the indices 0..7 modulo 3: 0, 3, 6; 1, 4, 7; 2, 5
    assert counts == {0: 3, 1: 3, 2: 2}


def test_names_and_columns_of_a_row_stay_together():
    buffer = ReplayBuffer(6, "cpu")
    for start in (0, 4, 8):
        numbers = torch.arange(start, start + 4)
        buffer.store({"x": rows(*numbers.tolist())["x"], "y": numbers.view(-1, 1, 1)})
    sample = buffer.sample(6)
    assert torch.equal(sample["x"][:, 1], 10 * sample["x"][:, 0])
    assert torch.equal(sample["x"][:, 0].long(), sample["y"].flatten())
    assert sample["y"].shape == (6, 1, 1)
    assert sample["y"].dtype == torch.int64


def test_the_store_is_no_view_of_what_was_given_or_drawn():
    given = rows(1, 2)
    buffer = ReplayBuffer(2, "cpu")
    buffer.store(given)
    given["x"].fill_(-1)
    buffer.sample(2)["x"].fill_(-1)
    assert content(buffer) == [1, 2]


def test_reset_forgets_everything():
    buffer = ReplayBuffer(3, "cpu")
    buffer.store(rows(1, 2))
    buffer.reset()
    assert buffer.get_total_count() == 0
    buffer.store(rows(7))
    assert set(buffer.sample(3)["x"][:, 0].tolist()) == {7.0}
