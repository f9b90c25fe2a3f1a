"""How torch's idle OpenMP threads wait: asleep, unless the user has decided otherwise.

OpenMP's idle threads spin, in torch's builds some 10 ms behind each operation, on CPUs that the
physics or another process needs. On a busy machine every operation of a network then waits for a
thread that the system has put aside: a training becomes ten to forty times slower
(`python -m benchmarks.threads`). OpenMP reads how to wait once, when torch is imported.
"""

from __future__ import annotations

import os
import sys

# What a user says about waiting; any of them decides.
_WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
_spins = False


def let_threads_sleep() -> None:
    """Set OMP_WAIT_POLICY=PASSIVE for torch's import, unless the environment says how to wait.

    The variable counts for whoever reads it later in this process, and for processes started by it.
    If torch was imported before, nothing is set, as nothing would read it; see `threads_spin`.
    """
    global _spins
    if any(name in os.environ for name in _WAITING):
        return
    if "torch" in sys.modules:
        _spins = True
    else:
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"


def threads_spin() -> bool:
    """Whether torch was imported too early to be given a policy, and nobody else gave it one."""
    return _spins
