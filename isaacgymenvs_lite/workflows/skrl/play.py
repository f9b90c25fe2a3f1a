"""Plays an agent of skrl: isaacgymenvs-lite workflows skrl play."""

import sys

from isaacgymenvs_lite.workflows.skrl import LIBRARY
from isaacgymenvs_lite.workflows.training import play

if __name__ == "__main__":
    sys.exit(play(LIBRARY))
