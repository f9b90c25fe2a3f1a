"""Plays an agent of rsl_rl: python -m isaacgymenvs_lite.workflows.rsl_rl.play --help."""

from __future__ import annotations

import sys

from isaacgymenvs_lite.workflows.playing import play
from isaacgymenvs_lite.workflows.rsl_rl import LIBRARY

if __name__ == "__main__":
    sys.exit(play(LIBRARY))
