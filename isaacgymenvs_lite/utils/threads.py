"""How many threads torch may use where."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


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
