"""Trains an agent of rsl_rl: isaacgymenvs-lite workflows rsl_rl train."""

import sys

from isaacgymenvs_lite.workflows.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["rsl_rl", "train", *sys.argv[1:]]))
