"""The dataset of one epoch, which returns random minibatches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from rl_games.common.datasets import PPODataset

from isaacgymenvs_lite.learning.published_names import PublishedNames


class AMPDataset(PublishedNames, PPODataset):
    """rl_games' dataset with random minibatches.

    A pass over the dataset returns each row once, in a random order that is drawn at the end of the
    last pass. Unlike in rl_games, the stored means and standard deviations of the policy are those
    of the rollout in all passes.

    `row_limits` sets the largest number of rows that a minibatch has of a field; by default a
    minibatch has all of its rows.
    """

    def __init__(
        self,
        batch_size: int,
        minibatch_size: int,
        is_discrete: bool,
        is_rnn: bool,
        device: str,
        seq_length: int,
        row_limits: Mapping[str, int] | None = None,
    ) -> None:
        super().__init__(batch_size, minibatch_size, is_discrete, is_rnn, device, seq_length)
        self._row_limits = dict(row_limits or {})
        self._idx_buf = torch.randperm(self.batch_size, device=self.device)

    def state_dict(self) -> dict[str, Any]:
        """Return the random order of the rows."""
        return {"order": self._idx_buf.cpu().clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the order of the rows, which are fewer if simulations diverged in the epoch."""
        order = state["order"]
        is_order = torch.equal(order.sort().values, torch.arange(len(order)))
        if not is_order or len(order) > self.batch_size:
            raise ValueError(f"an order of {len(order)} rows, expected {self.batch_size}")
        self._idx_buf = order.to(self.device)

    def update_values_dict(self, values_dict: dict[str, Any]) -> None:
        """Set the rows of an epoch; each tensor has `batch_size` rows."""
        super().update_values_dict(values_dict)
        if len(self._idx_buf) != self.batch_size:
            self._shuffle_idx_buf()

    def _get_item(self, idx: int) -> dict[str, Any]:
        rows = self._idx_buf[idx * self.minibatch_size : (idx + 1) * self.minibatch_size]
        minibatch = {
            name: values.index_select(0, rows[: self._row_limits.get(name, self.minibatch_size)])
            for name, values in self.values_dict.items()
            if name not in self.special_names and values is not None
        }
        if idx == self.length - 1:
            self._shuffle_idx_buf()
        return minibatch

    def _shuffle_idx_buf(self) -> None:
        """Draw a random order of the rows for the next pass."""
        self._idx_buf = torch.randperm(self.batch_size, device=self.device)
