"""Several processes that train one policy, on CPUs or GPUs, on one machine or many."""

import os

STARTS = "ISAACGYMENVS_LITE_STARTS"
"""Environment variable: how often a process has replaced itself by a new one (`pbt.restart`)."""


def started_by_torchrun() -> bool:
    """Return whether torchrun started this process together with others."""
    return int(os.environ.get("WORLD_SIZE") or 1) > 1
