"""Compares the memory that a program needs with the machine's memory, before any is allocated.

Linux grants more memory than the machine has, and kills the process without a message when the
memory is used.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError

_GIB = 2**30
# Files with the memory limit of the container, one for each version of control groups; "max" means
# no limit.
_CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def total_memory_bytes() -> int | None:
    """Return the bytes of memory of this machine or container, or None if they are unknown."""
    limits = []
    if hasattr(os, "sysconf"):  # not on Windows
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for file in _CGROUP_LIMITS:
        try:
            text = file.read_text(encoding="ascii").strip()
        except (OSError, ValueError):
            continue
        if text.isdecimal():
            limits.append(int(text))
    return min((limit for limit in limits if limit > 0), default=None)


def check_memory(needed: Mapping[str, float], advice: str, total_bytes: int | None = None) -> None:
    """Refuse a memory use that exceeds the memory of this machine.

    Args:
        needed: maps each purpose to a lower bound of the bytes that it needs.
        advice: settings to lower, for the message.
        total_bytes: memory of the machine; None reads it from the system.

    Raises:
        ConfigError: the sum exceeds the machine's memory.
    """
    total_bytes = total_bytes or total_memory_bytes()
    needed_bytes = sum(needed.values())
    if total_bytes is None or needed_bytes <= total_bytes:
        return
    largest = sorted(needed.items(), key=lambda item: -item[1])
    parts = ", ".join(
        f"{what} {_gib(size)}" for what, size in largest if size > 0.01 * needed_bytes
    )
    raise ConfigError(
        f"not enough memory: this needs at least {_gib(needed_bytes)} ({parts}), and this machine"
        f" has {_gib(total_bytes)}; lower {advice}"
    )


def _gib(size: float) -> str:
    return f"{size / _GIB:,.1f} GiB"
