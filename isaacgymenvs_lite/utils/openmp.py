"""Makes torch's idle OpenMP threads sleep, unless an environment variable decides otherwise.

OpenMP's idle threads spin for some 10 ms after each operation of torch, and occupy CPUs that the
physics or another process needs. On a busy machine every operation of a network then waits for a
thread that the system has suspended, which makes a training ten to forty times slower. OpenMP reads
its waiting policy once, when torch is imported.
"""

from __future__ import annotations

import os
import sys

# The user chooses the waiting policy by any of these environment variables.
_WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
_spins = False


def let_threads_sleep() -> None:
    """Set OMP_WAIT_POLICY=PASSIVE before torch's import, unless the environment has a setting.

    Child processes inherit the variable. Nothing is set if torch was imported before, because
    OpenMP would not read the variable any more; see `threads_spin`.
    """
    global _spins
    if any(name in os.environ for name in _WAITING):
        return
    if "torch" in sys.modules:
        _spins = True
    else:
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"


def threads_spin() -> bool:
    """Return whether torch's idle threads spin, because torch was imported first."""
    return _spins
