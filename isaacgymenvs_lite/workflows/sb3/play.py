"""Plays an agent of Stable-Baselines3: isaacgymenvs-lite workflows sb3 play."""

import sys

from isaacgymenvs_lite.workflows.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["sb3", "play", *sys.argv[1:]]))
