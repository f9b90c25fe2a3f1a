"""The machine a number was measured on, in one line."""

from __future__ import annotations

import os
import platform

import mujoco
import torch

from isaacgymenvs_lite.installation import cpu_name


def describe_machine() -> str:
    """Return processor, cores, and the versions that matter."""
    return (
        f"{cpu_name()}, {os.cpu_count()} cores, Python {platform.python_version()},"
        f" torch {torch.__version__}, mujoco {mujoco.__version__}"
    )
