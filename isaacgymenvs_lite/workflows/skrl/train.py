"""Trains an agent of skrl: isaacgymenvs-lite workflows skrl train."""

import sys

from isaacgymenvs_lite.workflows.skrl import LIBRARY
from isaacgymenvs_lite.workflows.training import train

if __name__ == "__main__":
    sys.exit(train(LIBRARY))
