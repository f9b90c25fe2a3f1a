"""A training whose epochs somebody else decides, so that it can be measured from inside."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from typing import Any

from omegaconf import DictConfig

from isaacgymenvs_lite.runner import train


class MeasuredError(Exception):
    """Ends the training: what was to be measured is."""


class EpochTimes:
    """Stands in for an agent's `train_epoch` and notes how long each epoch takes, logging included.

    Args:
        epoch: the agent's own.
        warm_up: epochs that do not count.
        count: epochs that do; then the training ends with `MeasuredError`.
        between: called with the agent after each epoch that counts, not timed.
        at_end: called with the agent at the end.

    Attributes:
        seconds: of the epochs that count.
        frames_per_epoch: over all environments.
    """

    def __init__(
        self,
        epoch: Callable[[Any], Any],
        warm_up: int,
        count: int,
        between: Callable[[Any], None] = lambda agent: None,
        at_end: Callable[[Any], None] = lambda agent: None,
    ) -> None:
        self._epoch, self._warm_up, self._count = epoch, warm_up, count
        self._between, self._at_end = between, at_end
        self._all: list[float] = []
        self._start_s: float | None = None
        self.frames_per_epoch = 0

    @property
    def seconds(self) -> list[float]:
        return self._all[self._warm_up :]

    def __call__(self, agent: Any) -> Any:
        """Note the epoch before and run the next."""
        if self._start_s is not None:
            self._all.append(time.perf_counter() - self._start_s)
        if self.seconds:
            self._between(agent)
        if len(self.seconds) == self._count:
            self.frames_per_epoch = agent.batch_size
            self._at_end(agent)
            raise MeasuredError
        self._start_s = time.perf_counter()
        return self._epoch(agent)


@contextmanager
def epochs_replaced(agent_class: Any, epoch: Callable[[Any], Any]):
    """Let `agent_class.train_epoch` be `epoch` until `MeasuredError` ends the training."""
    former = agent_class.train_epoch
    agent_class.train_epoch = lambda agent: epoch(agent)
    try:
        yield
    except MeasuredError:
        pass
    finally:
        agent_class.train_epoch = former


def train_from_inside(cfg: DictConfig, agent_class: Any, epoch: Callable[[Any], Any]) -> None:
    """Train until `MeasuredError`, or the configuration's end.

    What is printed during a training goes to the log: keep results, and print them afterwards.

    Args:
        cfg: a composed tree.
        agent_class: of the agent that it trains.
        epoch: called with the agent in place of `agent_class.train_epoch`.
    """
    cfg.seed = 0
    with epochs_replaced(agent_class, epoch):
        train(cfg)


def last_number_of(
    module: str, *arguments: str, environment: Mapping[str, str] | None = None
) -> float:
    """Return the number that `python -m module arguments` prints last, in a process of its own.

    Args:
        module: with a `main`.
        arguments: words of its command line.
        environment: all of its variables; None: those of this process.

    Raises:
        RuntimeError: it failed; with the end of what it said.
    """
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return float(done.stdout.split()[-1])
