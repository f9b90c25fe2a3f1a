"""Trains with a replaced `train_epoch`, which allows measurements inside of a training."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from omegaconf import DictConfig

from isaacgymenvs_lite.runner import train


class MeasuredError(Exception):
    """Ends a training after its measurement."""


class EpochTimes:
    """Replaces an agent's `train_epoch` and measures the seconds of each epoch, with its logging.

    Args:
        epoch: the replaced method.
        warm_up: number of epochs before the measurement.
        count: number of measured epochs, after which `MeasuredError` ends the training.
        between: called with the agent after each measured epoch; the call is not timed.
        at_end: called with the agent at the end.

    Attributes:
        seconds: times of the measured epochs.
    """

    def __init__(
        self,
        epoch: Callable[[Any], Any],
        warm_up: int,
        count: int,
        between: Callable[[Any], None],
        at_end: Callable[[Any], None],
    ) -> None:
        self._epoch, self._warm_up, self._count = epoch, warm_up, count
        self._between, self._at_end = between, at_end
        self._all: list[float] = []
        self._start_s: float | None = None

    @property
    def seconds(self) -> list[float]:
        return self._all[self._warm_up :]

    def __call__(self, agent: Any) -> Any:
        """Note the time of the previous epoch and run the next epoch."""
        if self._start_s is not None:
            self._all.append(time.perf_counter() - self._start_s)
        if self.seconds:
            self._between(agent)
        if len(self.seconds) == self._count:
            self._at_end(agent)
            raise MeasuredError
        self._start_s = time.perf_counter()
        return self._epoch(agent)


def train_from_inside(cfg: DictConfig, agent_class: Any, epoch: Callable[[Any], Any]) -> None:
    """Train with seed 0 until `MeasuredError` or until the configured end.

    The training redirects standard output to its log. Print results only after this function.

    Args:
        cfg: a composed tree.
        agent_class: class of the trained agent.
        epoch: called with the agent in place of `agent_class.train_epoch`.
    """
    cfg.seed = 0
    former = agent_class.train_epoch
    agent_class.train_epoch = lambda agent: epoch(agent)
    try:
        with suppress(MeasuredError):
            train(cfg)
    finally:
        agent_class.train_epoch = former
