"""Computes means and variances over the rows of all processes with one message.

Deviations from a point near the mean are summed in float64, so that no digits are lost if the mean
is much larger than the standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.distributed.group import current_group


@dataclass(frozen=True)
class Moments:
    """Count, mean (...) and mean squared deviation (...), float64, of the rows of all processes."""

    count: int
    mean: Tensor
    var: Tensor


def joined_moments(kinds: Sequence[tuple[Tensor, Tensor]]) -> list[Moments]:
    """Return the moments of several kinds of rows.

    Args:
        kinds: for each kind, a point (...) near the mean and the rows (n, ...) of this process. The
            point must be the same in all processes.
    """
    sums = []
    for near, rows in kinds:
        deviations = rows.double() - near.double()
        count = deviations.new_full((1,), len(rows))
        sums += [count, deviations.sum(0).flatten(), deviations.square_().sum(0).flatten()]
    joined = current_group().sum_(torch.cat(sums)).split([len(each) for each in sums])
    moments = []
    for i, (near, _) in enumerate(kinds):
        count, first, second = joined[3 * i : 3 * i + 3]
        first, second = first / count, second / count
        mean = near.double() + first.view(near.shape)
        moments.append(Moments(int(count), mean, (second - first.square()).view(near.shape)))
    return moments


def normalize_jointly(values: Tensor, mask: Tensor) -> Tensor:
    """Return values (n,), normalised by the mean and standard deviation over all processes.

    Only values whose mask (n,) is 1 enter the mean and the unbiased variance. If fewer than two
    values have the mask 1, all values are returned unchanged.
    """
    wide, weight = values.double(), mask.double()
    sums = torch.stack([weight.sum(), (weight * wide).sum(), (weight * wide.square()).sum()])
    count, first, second = current_group().sum_(sums).tolist()
    if count < 2:
        return values
    mean = first / count
    var = max(0.0, second / count - mean * mean) * count / (count - 1)
    return (values - mean) / (var**0.5 + 1e-8)
