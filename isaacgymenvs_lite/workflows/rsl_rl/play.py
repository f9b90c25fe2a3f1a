"""Plays an agent of rsl_rl: isaacgymenvs-lite workflows rsl_rl play."""

import sys

from isaacgymenvs_lite.workflows.rsl_rl import LIBRARY
from isaacgymenvs_lite.workflows.training import play

if __name__ == "__main__":
    sys.exit(play(LIBRARY))
