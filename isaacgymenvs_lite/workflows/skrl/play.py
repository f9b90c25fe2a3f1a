"""Plays an agent of skrl: python -m isaacgymenvs_lite.workflows.skrl.play --help."""

from __future__ import annotations

import sys

from isaacgymenvs_lite.workflows.playing import play
from isaacgymenvs_lite.workflows.skrl import LIBRARY

if __name__ == "__main__":
    sys.exit(play(LIBRARY))
