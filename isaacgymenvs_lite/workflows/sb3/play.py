"""Plays an agent of Stable-Baselines3: python -m isaacgymenvs_lite.workflows.sb3.play --help."""

from __future__ import annotations

import sys

from isaacgymenvs_lite.workflows.playing import play
from isaacgymenvs_lite.workflows.sb3 import LIBRARY

if __name__ == "__main__":
    sys.exit(play(LIBRARY))
