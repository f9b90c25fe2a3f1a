"""Makes the clips that ship: python -m isaacgymenvs_lite.motion.synthesis [--out DIR]."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

import mujoco

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.motion.loader import shipped_motions_dir
from isaacgymenvs_lite.motion.npz import save_npz
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.motion.synthesis.gait_data import GAITS
from isaacgymenvs_lite.motion.synthesis.generate import FPS, MODEL, generate
from isaacgymenvs_lite.motion.synthesis.report import describe

_log = logging.getLogger(__name__)

NUM_CYCLES = {"walk": 4, "run": 5}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line: write the clips and log their measured figures.

    Returns:
        The exit code.
    """
    parser = argparse.ArgumentParser(
        prog="python -m isaacgymenvs_lite.motion.synthesis",
        description="Makes walking and running clips from published gait data.",
    )
    parser.add_argument(
        "--out", type=Path, help="folder for the clips (default: assets/amp/motions)"
    )
    parser.add_argument("--clips", nargs="+", choices=list(GAITS), default=list(GAITS))
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = options.out or shipped_motions_dir()
    model_path = str(paths.assets_dir() / MODEL)
    skeleton = Skeleton.from_mjcf(model_path)
    model = mujoco.MjModel.from_xml_path(model_path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in options.clips:
            clip = generate(GAITS[name], NUM_CYCLES[name])
            path = save_npz(folder / f"{name}.npz", clip)
            frames_per_cycle = round(GAITS[name].period_s * FPS)
            _log.info("%s\n%s", path, describe(clip, frames_per_cycle, skeleton, model))
    except (UserError, OSError) as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
