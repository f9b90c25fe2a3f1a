"""How many threads work where: the physics, the networks and the tensors between them take turns.

All three are given the same number, the key `num_threads`, and never work at the same time, so
that no two of them fight for a CPU. docs/speed.md has the measurements.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


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
