"""How many threads work where: the physics, the networks and the tensors between them take turns.

With `train.py` all three are given the same number, the key `num_threads`, and never work at the
same time, so that no two of them fight for a CPU.

Other trainers compute with torch's own threads, which meet behind every operation. For few rows
that costs more than it saves, and on a busy machine each meeting waits for a thread that the system
has put aside. So torch is limited to fewer threads while a small task is open
(`limit_torch_threads`). docs/speed.md has the measurements.
"""

from __future__ import annotations

import logging
import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from isaacgymenvs_lite.utils.openmp import threads_spin

log = logging.getLogger(__name__)

# A second thread begins to pay from twice as much on, on a machine with nothing else to do.
_ENVS_PER_THREAD = 256
_PRODUCTS_PER_THREAD = 20_000_000
# A user's choice.
_COUNTS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")


def thread_count(num_threads: int = 0) -> int:
    """Return `num_threads`, or for 0 the number of CPUs that this process may use."""
    if num_threads > 0:
        return num_threads
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run torch's CPU operations on the calling thread only.

    A task's tensors are small: waking a second thread costs more than it saves (observations of
    1,024 humanoids take half the time on one thread), and the physics threads want the CPUs.
    """
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def threads_for_envs(num_envs: int) -> int:
    """Return the torch threads that a trainer of a task can use, known by its environments only.

    A minibatch of PPO has some eight rows for each environment.
    """
    return max(1, num_envs // _ENVS_PER_THREAD)


def threads_for_products(products: int) -> int:
    """Return the torch threads that a gradient step can use.

    Args:
        products: rows of a minibatch times parameters of the networks.
    """
    return max(1, products // _PRODUCTS_PER_THREAD)


def limit_torch_threads(task: Any, most: int, num_threads: int = 0) -> None:
    """Let torch compute on at most so many threads until `task` is closed.

    The process has one such number. It is changed only here, with one line in the log, and put back
    when the last task is closed. With several tasks open the highest limit counts. It is left alone

    - when OMP_NUM_THREADS or MKL_NUM_THREADS is set, unless `num_threads` is,
    - when torch has another number than the one that it takes by itself, again unless it is, and
    - for good, once somebody calls `torch.set_num_threads` while a task is open.

    Args:
        task: what the limit is for; a second call replaces the first one's limit.
        most: see `threads_for_envs` and `threads_for_products`.
        num_threads: the key; unless 0 it counts instead of `most`.
    """
    _limits.add(task, num_threads or most, is_chosen=num_threads > 0)


def release_torch_threads(task: Any) -> None:
    """Forget a task's limit; without one nothing happens."""
    _limits.remove(id(task))


@contextmanager
def trainer_sets_threads() -> Iterator[None]:
    """Let nothing limit torch for tasks made inside: their trainer has a key of its own."""
    _limits.held_off += 1
    try:
        yield
    finally:
        _limits.held_off -= 1


class _TorchThreads:
    """Torch's number of threads and who limits it; there is one, as torch has one number.

    Attributes:
        limits: of each open task, by its id.
        before: torch's number without them; None while there are none.
        given: the number that was set last.
        held_off: how many trainers set the number themselves at present.
    """

    def __init__(self) -> None:
        self.limits: dict[int, int] = {}
        self.before: int | None = None
        self.given = self.held_off = 0
        self._has_told = False

    def add(self, task: Any, most: int, is_chosen: bool = False) -> None:
        if self.held_off:
            return
        if not self.limits:
            number = torch.get_num_threads()
            if _is_chosen(number) and not is_chosen:
                return
            self.before = self.given = number
        if id(task) not in self.limits:
            # A task that nobody closes must not hold it for ever.
            weakref.finalize(task, self.remove, id(task)).atexit = False
        self.limits[id(task)] = most
        self._apply()

    def remove(self, key: int) -> None:
        if self.limits.pop(key, None) is not None:
            self._apply()

    def _apply(self) -> None:
        before = self.before
        if before is None:
            return
        if torch.get_num_threads() != self.given:
            self.before = None  # somebody else has decided
        else:
            self.given = min(before, max(self.limits.values(), default=before))
            torch.set_num_threads(self.given)
            if self.limits:
                self._tell(before)
        if not self.limits:
            self.before = None

    def _tell(self, before: int) -> None:
        if self._has_told:
            return
        if self.given < before:
            self._has_told = True
            log.warning(
                "torch computes on %d thread(s), not %d, while this small task is open;"
                " OMP_NUM_THREADS=n or torch.set_num_threads(n) after making it decides otherwise",
                self.given,
                before,
            )
        elif before > 1 and threads_spin():
            self._has_told = True
            log.warning(
                "torch was imported before isaacgymenvs_lite: its idle threads spin on the CPUs of"
                " the physics; import isaacgymenvs_lite first, or set OMP_WAIT_POLICY=PASSIVE"
            )


def _is_chosen(number: int) -> bool:
    """Whether a user has chosen torch's number of threads: torch takes one for each core."""
    cpus = thread_count()
    by_itself = (cpus, max(1, cpus // 2))  # a core may be two CPUs
    return number not in by_itself or any(name in os.environ for name in _COUNTS)


_limits = _TorchThreads()
