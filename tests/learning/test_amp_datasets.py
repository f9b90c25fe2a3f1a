from __future__ import annotations

from typing import Any

import pytest
import torch

from isaacgymenvs_lite.learning.amp_datasets import AMPDataset

BATCH, MINIBATCH = 24, 6


def make(row_limits: dict[str, int] | None = None, **values: Any) -> Any:
    dataset = AMPDataset(BATCH, MINIBATCH, False, False, "cpu", 1, row_limits)
    numbers = torch.arange(BATCH)
    dataset.update_values_dict({"a": numbers, "b": numbers.view(-1, 1) * 10.0, **values})
    return dataset


def one_pass(dataset: Any) -> list[int]:
    return [int(row) for index in range(len(dataset)) for row in dataset[index]["a"]]


def test_every_pass_has_every_row_once_in_another_order():
    torch.manual_seed(1)
    dataset = make()
    passes = [one_pass(dataset) for _ in range(4)]
    for seen in passes:
        assert sorted(seen) == list(range(BATCH))
    # two equal ones by chance: 6 in 24!
    assert len({tuple(seen) for seen in passes}) == 4
    assert sorted(passes[0]) != passes[0]


def test_the_order_changes_after_the_last_minibatch_only():
    dataset = make()
    first = dataset[0]["a"]
    dataset[2]
    assert torch.equal(dataset[0]["a"], first)
    dataset[len(dataset) - 1]
    # equal by chance: fewer than 1 in 24!/18! = 9.7e7
    assert not torch.equal(dataset[0]["a"], first)


def test_the_names_of_a_row_stay_together():
    minibatch = make()[1]
    assert minibatch["a"].shape == (MINIBATCH,)
    assert minibatch["b"].shape == (MINIBATCH, 1)
    assert torch.equal(minibatch["b"].flatten(), minibatch["a"] * 10.0)


def test_row_limits_give_the_first_rows_of_the_same_minibatch():
    numbers = torch.arange(BATCH)
    dataset = make({"c": 2, "d": 100}, c=numbers, d=numbers)
    for index in range(len(dataset)):
        minibatch = dataset[index]
        assert torch.equal(minibatch["c"], minibatch["a"][:2])
        assert torch.equal(minibatch["d"], minibatch["a"])


def test_absent_rows_are_left_out():
    minibatch = make(rnn_masks=None, rnn_states=None)[0]
    assert set(minibatch) == {"a", "b"}


def test_rows_are_let_go_between_epochs():
    dataset = make()
    one_pass(dataset)
    dataset.update_values_dict(None)  # rl_games does so after every epoch
    dataset.update_values_dict({"a": torch.arange(BATCH)})
    assert sorted(one_pass(dataset)) == list(range(BATCH))


def test_a_minibatch_that_does_not_divide_the_batch_is_refused():
    with pytest.raises(ValueError, match="divisible"):
        AMPDataset(10, 4, False, False, "cpu", 1)
