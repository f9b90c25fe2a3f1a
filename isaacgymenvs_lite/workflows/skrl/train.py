"""Trains an agent of skrl: python -m isaacgymenvs_lite.workflows skrl train."""

import sys

from isaacgymenvs_lite.workflows.skrl import LIBRARY
from isaacgymenvs_lite.workflows.training import train

if __name__ == "__main__":
    sys.exit(train(LIBRARY))
