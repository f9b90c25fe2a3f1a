"""The scalars of an agent's updates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rl_games.algos_torch import torch_ext
from torch import Tensor


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
