from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.learning.cpu.row_slices import (
    evaluate_in_chunks,
    join,
    split_proportionally,
    sum_of_slices,
)


@pytest.mark.parametrize(
    ("lengths", "asked", "expected"),
    [
        ((12, 4), 2, [(6, 2), (6, 2)]),
        ((12, 4), 3, [(3, 1), (3, 1), (6, 2)]),
        ((12, 4), 9, [(3, 1)] * 4),
        ((12, 5), 4, [(12, 5)]),  # no common divisor
        ((7,), 2, [(3,), (4,)]),
    ],
)
def test_every_slice_has_the_same_share_of_all_tensors(lengths, asked, expected):
    rows = {str(i): torch.arange(n) for i, n in enumerate(lengths)}
    parts, shares = split_proportionally(rows, asked)
    assert [tuple(len(t) for t in part.values()) for part in parts] == expected
    assert shares == pytest.approx([part[0] / lengths[0] for part in expected])
    assert sum(shares) == pytest.approx(1.0)
    for name, tensor in rows.items():
        assert torch.equal(torch.cat([part[name] for part in parts]), tensor)


def test_numbers_are_averaged_by_their_shares_and_rows_put_together():
    assert join([torch.tensor(2.0), torch.tensor(6.0)], [0.25, 0.75]).item() == 5.0
    assert join([torch.tensor([1.0]), torch.tensor([2.0, 3.0])], [0.5, 0.5]).tolist() == [1, 2, 3]


def test_gradients_that_a_slice_does_not_have_count_as_zero():
    one = torch.ones(2)
    assert sum_of_slices((None, None)) is None
    assert torch.equal(sum_of_slices((None, one, 2 * one)), 3 * one)
    assert torch.equal(sum_of_slices((one, None)), one)


def test_more_rows_than_a_chunk_come_back_in_order_and_shape():
    rows = torch.arange(2.0 * 9000 * 3).view(2, 9000, 3).requires_grad_()
    seen: list[int] = []

    def sums(chunk: torch.Tensor) -> torch.Tensor:
        seen.append(len(chunk))
        return chunk.sum(dim=-1, keepdim=True).bfloat16()

    result = evaluate_in_chunks(sums, rows)
    assert seen == [8192, 8192, 1616]
    assert result.dtype == torch.float32
    assert not result.requires_grad
    assert torch.equal(result, rows.detach().sum(dim=-1, keepdim=True).bfloat16().float())
