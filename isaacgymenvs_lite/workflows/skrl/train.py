"""Trains an agent of skrl: isaacgymenvs-lite workflows skrl train."""

import sys

from isaacgymenvs_lite.workflows.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["skrl", "train", *sys.argv[1:]]))
