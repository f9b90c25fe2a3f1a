"""Trains an agent of rsl_rl: isaacgymenvs-lite workflows rsl_rl train."""

import sys

from isaacgymenvs_lite.workflows.rsl_rl import LIBRARY
from isaacgymenvs_lite.workflows.training import train

if __name__ == "__main__":
    sys.exit(train(LIBRARY))
