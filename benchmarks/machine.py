"""The machine a number was measured on, in one line."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import mujoco
import torch


def describe_machine() -> str:
    """Return processor, cores, and the versions that matter."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = lines[0].split(":", 1)[1].strip() if lines else cpu
    return (
        f"{cpu}, {os.cpu_count()} cores, Python {platform.python_version()},"
        f" torch {torch.__version__}, mujoco {mujoco.__version__}"
    )
