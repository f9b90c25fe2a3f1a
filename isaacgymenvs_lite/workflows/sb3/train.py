"""Trains an agent of Stable-Baselines3: isaacgymenvs-lite workflows sb3 train."""

import sys

from isaacgymenvs_lite.workflows.sb3 import LIBRARY
from isaacgymenvs_lite.workflows.training import train

if __name__ == "__main__":
    sys.exit(train(LIBRARY))
