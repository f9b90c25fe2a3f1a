"""Describes this machine in one line."""

from __future__ import annotations

import os
import platform

import mujoco
import torch

from isaacgymenvs_lite.commands.installation import cpu_name


def describe_machine() -> str:
    """Return processor, cores, GPU if present, and versions of Python, torch and MuJoCo."""
    gpu = f" {torch.cuda.get_device_name()}," if torch.cuda.is_available() else ""
    return (
        f"{cpu_name()}, {os.cpu_count()} cores,{gpu} Python {platform.python_version()},"
        f" torch {torch.__version__}, mujoco {mujoco.__version__}"
    )
