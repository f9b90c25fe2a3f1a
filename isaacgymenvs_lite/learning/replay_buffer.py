"""A ring buffer whose rows consist of named tensors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.learning.published_names import PublishedNames


class ReplayBuffer(PublishedNames):
    """Holds the newest `buffer_size` rows, like the ReplayBuffer of IsaacGymEnvs.

    `sample` walks through a random permutation of all rows, and then draws a new permutation. Every
    row is thus sampled once before any row is sampled twice. While the buffer is not full, indices
    are taken modulo the number of stored rows.
    """

    def __init__(self, buffer_size: int, device: str | torch.device) -> None:
        self._buffer_size = buffer_size
        self._device = torch.device(device)
        self._data_buf: dict[str, Tensor] = {}
        self.reset()

    def reset(self) -> None:
        """Remove all rows."""
        self._head = 0
        self._total_count = 0
        self._reset_sample_idx()

    def get_buffer_size(self) -> int:
        """Return the buffer's capacity in rows."""
        return self._buffer_size

    def get_total_count(self) -> int:
        """Return the number of rows stored since the last `reset`, including overwritten rows."""
        return self._total_count

    @property
    def rows(self) -> dict[str, Tensor]:
        """All stored rows {name: (n, ...)} in arbitrary order; callers must not change them."""
        n = min(self._total_count, self._buffer_size)
        return {name: ring[:n] for name, ring in self._data_buf.items()}

    def store(self, data: dict[str, Tensor]) -> None:
        """Append rows {name: (n, ...)}, whose names and row shapes are the same in every call."""
        n = len(next(iter(data.values())))
        if n == 0:
            return
        self._total_count += n
        kept = min(n, self._buffer_size)
        first = (self._head + (n - kept)) % self._buffer_size
        before_end = min(kept, self._buffer_size - first)
        if not self._data_buf:
            self._init_data_buf(data)
        for name, rows in data.items():
            ring, newest = self._data_buf[name], rows[n - kept :]
            ring[first : first + before_end] = newest[:before_end]
            ring[: kept - before_end] = newest[before_end:]
        self._head = (self._head + n) % self._buffer_size

    def _init_data_buf(self, data: dict[str, Tensor]) -> None:
        """Allocate ring buffers for rows of these shapes."""
        for name, rows in data.items():
            shape = (self._buffer_size, *rows.shape[1:])
            self._data_buf[name] = torch.empty(shape, dtype=rows.dtype, device=self._device)

    def store_some(self, data: dict[str, Tensor], keep_prob: float) -> None:
        """Append rows; once the buffer is full, store each row with probability `keep_prob`.

        If there are more rows than the buffer holds, a random subset is stored.
        """
        values = next(iter(data.values()))
        rows = torch.arange(len(values), device=values.device)
        if self._total_count > self._buffer_size:
            rows = rows[torch.rand(len(rows), device=rows.device) < keep_prob]
        if len(rows) > self._buffer_size:
            chosen = torch.randperm(len(rows), device=rows.device)
            rows = rows[chosen[: self._buffer_size]]
        self.store({name: values[rows] for name, values in data.items()})

    def sample(self, n: int) -> dict[str, Tensor]:
        """Return n rows {name: (n, ...)}; the buffer must not be empty."""
        order = (self._sample_head + torch.arange(n, device=self._device)) % self._buffer_size
        rows = self._sample_idx[order]
        if self._total_count < self._buffer_size:
            rows = rows % self._total_count
        self._sample_head += n
        if self._sample_head >= self._buffer_size:
            self._reset_sample_idx()
        return {name: stored.index_select(0, rows) for name, stored in self._data_buf.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return the stored rows, and the positions of the next stored and the next sampled row."""
        # The slice is copied, because `torch.save` would write the whole ring for a slice.
        is_full = self._total_count >= self._buffer_size
        rows = {name: row if is_full else row.clone() for name, row in self.rows.items()}
        counts = [self._head, self._total_count, self._sample_head]
        return {"rows": rows, "counts": counts, "order": self._sample_idx.cpu().clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the rows of another buffer, which must have the same size."""
        rows, order = state["rows"], state["order"]
        if not torch.equal(order.sort().values, torch.arange(self._buffer_size)):
            raise ValueError(f"a replay buffer of {len(order)} rows, expected {self._buffer_size}")
        if not self._data_buf:
            self._init_data_buf(rows)
        for name, values in rows.items():
            self._data_buf[name][: len(values)] = values
        self._head, self._total_count, self._sample_head = state["counts"]
        self._sample_idx = order.to(self._device)

    def _reset_sample_idx(self) -> None:
        """Draw a new random order in which rows are sampled."""
        self._sample_idx = torch.randperm(self._buffer_size, device=self._device)
        self._sample_head = 0
