"""Excludes transitions in which the simulation diverged from an update.

A task reports diverged simulations in `infos["diverged"]` (N,). Next state and reward of a diverged
transition are meaningless. The episode is treated as truncated before this transition: returns of
earlier steps are bootstrapped with the value V of the last valid observation. Recurrent networks
need whole sequences, therefore masks of rl_games remove the transition only from the losses;
normalisers still count its observation.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from rl_games.algos_torch.torch_ext import AverageMeter
from rl_games.common.experience import VectorizedReplayBuffer
from torch import Tensor

_COLUMNS = ("obses", "next_obses", "actions", "rewards", "dones")
"""Names of the tensors in rl_games' replay buffer."""


class RolloutMask:
    """Records the steps of a rollout in which simulations diverged.

    `num_steps` is the number of recorded steps.
    """

    def __init__(self, horizon: int) -> None:
        self._horizon = horizon
        self._diverged: dict[int, Tensor] = {}
        self.num_steps = 0

    def add(self, diverged: Tensor | None) -> None:
        """Record the next step, (N,) bool or None; after a complete rollout, start a new one."""
        if self.num_steps == self._horizon:
            self._diverged, self.num_steps = {}, 0
        if diverged is not None:
            self._diverged[self.num_steps] = diverged
        self.num_steps += 1

    @property
    def kept(self) -> Tensor | None:
        """(H, N) bool, False where a simulation diverged, or None if no simulation diverged."""
        if not self._diverged:
            return None
        shape = next(iter(self._diverged.values()))
        kept = torch.ones(self.num_steps, *shape.shape, dtype=torch.bool, device=shape.device)
        for step, diverged in self._diverged.items():
            kept[step] = ~diverged
        return kept


def take_rows(batch: dict[str, Any], kept: Tensor) -> dict[str, Any]:
    """Return a batch with only the rows where `kept` (B,) is True.

    Values that do not have B rows are unchanged.
    """
    rows = kept.nonzero().flatten()

    def of(values: Any) -> Any:
        if isinstance(values, dict):
            return {name: of(each) for name, each in values.items()}
        has_rows = isinstance(values, Tensor) and values.ndim > 0 and len(values) == len(kept)
        return values.index_select(0, rows) if has_rows else values

    return of(batch)


def fit_datasets(agent: Any, num_rows: int) -> None:
    """Set the minibatch sizes of an agent and its asymmetric critic for `num_rows` rows."""
    for owner in (agent, agent.central_value_net) if agent.has_central_value else (agent,):
        dataset = owner.dataset
        dataset.batch_size = num_rows
        dataset.minibatch_size = math.ceil(num_rows / owner.num_minibatches)
        dataset.length = math.ceil(num_rows / dataset.minibatch_size)


class EpisodeMeter(AverageMeter):
    """rl_games' meter for a mean over the last episodes, without diverged episodes.

    Attributes:
        left_out: (n,) bool, which episodes of the next `update` diverged, or None if no episode
            did.
    """

    left_out: Tensor | None = None

    def update(self, values: Tensor) -> None:
        """Add the values of n episodes, (n, ...)."""
        super().update(values if self.left_out is None else values[~self.left_out])


class EpisodeMeters:
    """Replaces meters of an agent, given by their names, which rl_games' loop updates."""

    def __init__(self, agent: Any, names: tuple[str, ...]) -> None:
        self._meters = []
        for name in names:
            former = getattr(agent, name)
            meter = EpisodeMeter(former.mean.shape, former.max_size).to(former.mean.device)
            setattr(agent, name, meter)
            self._meters.append(meter)

    def leave_out(self, diverged: Tensor | None, dones: Tensor) -> None:
        """Exclude diverged episodes, (N,) bool or None, from those that end now, `dones` (N,)."""
        left_out = None if diverged is None else diverged[dones.bool()]
        for meter in self._meters:
            meter.left_out = left_out


class KeptTransitions(VectorizedReplayBuffer):
    """rl_games' replay buffer, which leaves out diverged transitions.

    Attributes:
        left_out: (N,) bool, which rows of the next `add` diverged, or None if no row did.
    """

    left_out: Tensor | None = None

    def add(self, *rows: Tensor) -> None:
        """Store rows (N, ...): observations, actions, rewards, next observations, dones."""
        if self.left_out is not None:
            kept = ~self.left_out
            rows = tuple(each[kept] for each in rows)
        if len(rows[0]) > 0:
            super().add(*rows)

    def state_dict(self) -> dict[str, Any]:
        """Return the stored rows, and the index where the next row is stored."""
        n = self.capacity if self.full else self.idx
        # The slice is copied, because `torch.save` would write the whole tensor for a slice.
        rows = {name: getattr(self, name)[:n].cpu() for name in _COLUMNS}
        rows = rows if self.full else {name: row.clone() for name, row in rows.items()}
        return {"rows": rows, "idx": self.idx, "full": self.full}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the rows of another buffer, which must have the same size."""
        n = self.capacity if state["full"] else state["idx"]
        for name in _COLUMNS:
            getattr(self, name)[:n].copy_(state["rows"][name])
        self.idx, self.full = int(state["idx"]), bool(state["full"])
