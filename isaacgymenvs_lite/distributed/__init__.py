"""Several processes that train one policy, on CPUs or GPUs, on one machine or many."""

import os


def started_by_torchrun() -> bool:
    """Return whether torchrun started this process together with others."""
    return int(os.environ.get("WORLD_SIZE") or 1) > 1
