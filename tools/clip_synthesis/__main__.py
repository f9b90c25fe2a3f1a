"""Makes the shipped clips: python -m tools.clip_synthesis [--out DIR] [--clips NAME ...]."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

import mujoco

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.loader import shipped_motions_dir
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis.catalogue import GAIT_CLIPS, clip_names, make_clip
from tools.clip_synthesis.generate import MODEL
from tools.clip_synthesis.report import cycle_figures, describe, figures, overview

_log = logging.getLogger(__name__)


def main(arguments: list[str] | None = None) -> int:
    """Write the clips, log their measurements, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.clip_synthesis",
        description="Makes and measures the shipped clips.",
    )
    parser.add_argument(
        "--out", type=Path, help="folder for the clips (default: assets/amp/motions)"
    )
    parser.add_argument("--clips", nargs="+", choices=clip_names(), default=clip_names())
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = options.out or shipped_motions_dir()
    model_path = str(paths.assets_dir() / MODEL)
    skeleton = Skeleton.from_mjcf(model_path)
    model = mujoco.MjModel.from_xml_path(model_path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        rows = {}
        for name in options.clips:
            clip = make_clip(name)
            path = save_npz(folder / f"{name}.npz", clip)
            rows[name] = figures(clip, skeleton, model)
            cycle = GAIT_CLIPS.get(name)
            more = cycle_figures(clip, cycle.frames_per_cycle) if cycle else {}
            _log.info("%s\n%s", path, describe(rows[name] | more))
        _log.info("%s", overview(rows))
    except (UserError, OSError) as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
