"""Chooses the numbers of threads of the physics, the networks and the tensor operations.

`train.py` uses the key `num_threads` for all three. Physics, networks and tensor operations do not
compete for CPUs, because they never run at the same time.

Other trainers use torch's default number of threads. The threads synchronise after every operation,
which costs more time than the threads save if a tensor has few rows. On a busy machine each
synchronisation also waits for a thread that the system has suspended. torch is therefore limited to
fewer threads while a small task is open (`limit_torch_threads`). docs/speed.md has the
measurements.
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

# Least work for a second thread. On an idle machine a second thread saves time from twice this work
# on.
_ENVS_PER_THREAD = 256
_PRODUCTS_PER_THREAD = 20_000_000
# Users choose the number of threads by these environment variables.
_COUNTS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")


def thread_count(num_threads: int = 0) -> int:
    """Return `num_threads`, or the number of CPUs that this process may use if `num_threads` is 0.

    Processes that torchrun has started on one machine share its CPUs.
    """
    if num_threads > 0:
        return num_threads
    has_affinity = hasattr(os, "sched_getaffinity")
    cpus = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    return max(1, cpus // int(os.environ.get("LOCAL_WORLD_SIZE") or 1))


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run torch's CPU operations only on the calling thread.

    Waking a second thread costs more than it saves for a task's small tensors: the observations of
    1,024 humanoids take half the time on one thread. The CPUs are also needed by the threads of the
    physics.
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
    """Return the number of torch threads that a trainer can use for this number of environments.

    The estimate assumes eight rows of a minibatch for each environment, as in PPO.
    """
    return max(1, num_envs // _ENVS_PER_THREAD)


def threads_for_products(products: int) -> int:
    """Return the number of torch threads that a gradient step can use.

    Args:
        products: rows of a minibatch times parameters of the networks.
    """
    return max(1, products // _PRODUCTS_PER_THREAD)


def limit_torch_threads(task: Any, most: int, num_threads: int = 0) -> None:
    """Limit torch's threads until `task` is closed.

    The number of threads belongs to the process. The change is logged in one line, and the number
    is restored when the last task is closed. If several tasks are open, the highest limit counts.
    The number is not changed

    - if OMP_NUM_THREADS or MKL_NUM_THREADS is set, unless `num_threads` is set,
    - if torch's number of threads is not the default, unless `num_threads` is set, and
    - after a call of `torch.set_num_threads` while a task is open.

    Args:
        task: owner of the limit; a second call for the same task replaces the limit.
        most: see `threads_for_envs` and `threads_for_products`.
        num_threads: value of the key `num_threads`; a value above 0 replaces `most`.
    """
    torch_threads.add(task, num_threads or most, is_chosen=num_threads > 0)


def release_torch_threads(task: Any) -> None:
    """Remove a task's limit, if it has one."""
    torch_threads.remove(id(task))


@contextmanager
def trainer_sets_threads() -> Iterator[None]:
    """Disable limits inside the `with` statement, because the trainer sets torch's threads."""
    torch_threads.held_off += 1
    try:
        yield
    finally:
        torch_threads.held_off -= 1


class TorchThreads:
    """The limits of torch's number of threads; the process has one object of this class.

    Attributes:
        limits: maps the id of each open task to the limit of the task.
        before: torch's number of threads without limits, or None while there are no limits.
        given: the number of threads that this object set last.
        held_off: how many trainers currently set the number of threads instead of this object.
    """

    def __init__(self) -> None:
        self.limits: dict[int, int] = {}
        self.before: int | None = None
        self.given = self.held_off = 0
        self._has_warned = False

    def add(self, task: Any, most: int, is_chosen: bool = False) -> None:
        """Set a task's limit; if `is_chosen`, the limit overrides the user's other settings."""
        if self.held_off:
            return
        if not self.limits:
            number = torch.get_num_threads()
            if _is_chosen(number) and not is_chosen:
                return
            self.before = self.given = number
        if id(task) not in self.limits:
            # When a task that was not closed is deleted, its limit must end.
            weakref.finalize(task, self.remove, id(task)).atexit = False
        self.limits[id(task)] = most
        self._apply()

    def remove(self, key: int) -> None:
        """Remove the limit of the task with this id, if there is one."""
        if self.limits.pop(key, None) is not None:
            self._apply()

    def _apply(self) -> None:
        before = self.before
        if before is None:
            return
        if torch.get_num_threads() != self.given:
            self.before = None  # other code has set the number, so it stays
        else:
            self.given = min(before, max(self.limits.values(), default=before))
            torch.set_num_threads(self.given)
            if self.limits:
                self._warn_once(before)
        if not self.limits:
            self.before = None

    def _warn_once(self, before: int) -> None:
        if self._has_warned:
            return
        if self.given < before:
            self._has_warned = True
            log.warning(
                "torch computes on %d thread(s), not %d, while this small task is open; to choose"
                " another number set OMP_NUM_THREADS=n or call torch.set_num_threads(n) afterwards",
                self.given,
                before,
            )
        elif before > 1 and threads_spin():
            self._has_warned = True
            log.warning(
                "torch was imported before isaacgymenvs_lite, so its idle threads occupy the CPUs"
                " of the physics; import isaacgymenvs_lite first, or set OMP_WAIT_POLICY=PASSIVE"
            )


def _is_chosen(number: int) -> bool:
    """Return whether a user has chosen torch's number of threads; its default is one per core."""
    cpus = thread_count()
    defaults = (cpus, max(1, cpus // 2))  # a core may be two CPUs
    return number not in defaults or any(name in os.environ for name in _COUNTS)


torch_threads = TorchThreads()
