"""Plays an agent of Stable-Baselines3: isaacgymenvs-lite workflows sb3 play."""

import sys

from isaacgymenvs_lite.workflows.sb3 import LIBRARY
from isaacgymenvs_lite.workflows.training import play

if __name__ == "__main__":
    sys.exit(play(LIBRARY))
