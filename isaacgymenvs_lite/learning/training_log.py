"""What an agent measures while it trains: finished episodes, and the scalars of its updates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rl_games.algos_torch import torch_ext
from torch import Tensor


class EpisodeStatistics:
    """Adds up what running episodes earn, and passes finished ones to rl_games' meters.

    Args:
        sums: one tensor (N, ...) for each quantity, zero at the start of an episode.
        meters: one for each; rl_games logs and saves by their means.
    """

    def __init__(self, sums: Sequence[Tensor], meters: Sequence[Any]) -> None:
        self._sums, self._meters = sums, meters

    def add(self, step: Sequence[Tensor | float], dones: Tensor, finished: Tensor) -> None:
        """Count a step.

        Args:
            step: what it added to each quantity.
            dones: (N,) 1 where the episode ended.
            finished: (n, 1) rows of the episodes that ended.
        """
        going_on = 1.0 - dones.float()
        for total, meter, value in zip(self._sums, self._meters, step, strict=True):
            total += value
            meter.update(total[finished])
            total *= going_on.view(-1, *(1,) * (total.ndim - 1))


class TrainingLog:
    """Collects scalars in an epoch and writes their means to TensorBoard.

    Args:
        tags: name of a scalar -> its name in TensorBoard; others are only collected.

    Attributes:
        values: one value for each minibatch or epoch, by name; of the current epoch.
    """

    def __init__(self, tags: Mapping[str, str]) -> None:
        self._tags = tags
        self.values: dict[str, list[Tensor]] = {}

    def start_epoch(self) -> None:
        """Drop what the last epoch collected."""
        self.values = {}

    def add(self, scalars: Mapping[str, Tensor]) -> None:
        """Keep values of a minibatch or of an epoch."""
        for name, value in scalars.items():
            self.values.setdefault(name, []).append(value)

    def means(self) -> dict[str, float]:
        """Return the epoch means of all collected scalars."""
        return {name: torch_ext.mean_list(values).item() for name, values in self.values.items()}

    def write(self, writer: Any, train_info: Mapping[str, Any], frame: int) -> None:
        """Write the means of the lists in `train_info` that have a tag."""
        for name, tag in self._tags.items():
            if name in train_info:
                writer.add_scalar(tag, torch_ext.mean_list(train_info[name]).item(), frame)
