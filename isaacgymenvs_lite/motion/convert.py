"""Converts motion clips: python -m isaacgymenvs_lite.motion.convert IN OUT [key=value ...].

    python -m isaacgymenvs_lite.motion.convert amp_humanoid_walk.npy walk.npz
    python -m isaacgymenvs_lite.motion.convert walk.npz walk.csv fps=30 start_s=0.5 end_s=2
    python -m isaacgymenvs_lite.motion.convert dance.bvh dance.npz mapping=lafan1

IN is a clip as task.env.motion_file takes it (not a data set), or a .bvh file. The suffix of OUT
determines its format: .npz (this project's), .npy (poselib's), .txt or .json (DeepMimic's), .csv
(joint angles). Keys:

    fps=30              frames per second of OUT (default: as IN)
    start_s=0 end_s=5   the part of IN to keep, in seconds
    mapping=cmu         for .bvh: cmu, lafan1, or a YAML file; see docs/motion_formats.md
    num_dofs=31         of the humanoid: 28, or 31 with sword and shield (default: as IN, else 28)
    overwrite=True      OUT may exist
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from isaacgymenvs_lite.command_line import run_command
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.editing import cut, resample
from isaacgymenvs_lite.motion.formats.deepmimic import save_deepmimic
from isaacgymenvs_lite.motion.formats.files import check_output
from isaacgymenvs_lite.motion.formats.joint_csv import save_joint_csv
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.formats.poselib import save_poselib_npy
from isaacgymenvs_lite.motion.loader import load_single_clip
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping, shipped_mappings
from isaacgymenvs_lite.motion.retargeting.retarget import retarget_bvh
from isaacgymenvs_lite.motion.skeleton import SHIPPED_NUM_DOFS, Skeleton, skeleton_for_num_dofs
from isaacgymenvs_lite.schema import setting

_log = logging.getLogger(__name__)

_POSES_ONLY = "velocities (they are computed again from the poses) and limb lengths"


@dataclass(frozen=True)
class _Format:
    """How a clip is written, and what the format loses of it."""

    save: Callable[[Path, MotionClip, Skeleton], object]
    lost: str


_DEEPMIMIC = _Format(
    lambda path, clip, _skeleton: save_deepmimic(path, clip),
    f"{_POSES_ONLY}, rotations of the hands, sword and shield, and of knees and elbows out of "
    "their axes; reading lifts a clip whose feet are below the ground",
)
_FORMATS = {
    ".npz": _Format(lambda path, clip, _skeleton: save_npz(path, clip), "nothing"),
    ".npy": _Format(
        lambda path, clip, _skeleton: save_poselib_npy(path, clip),
        "digits beyond single precision",
    ),
    ".txt": _DEEPMIMIC,
    ".json": _DEEPMIMIC,
    ".csv": _Format(save_joint_csv, f"{_POSES_ONLY}; rotations of hinges out of their axes"),
}


@dataclass(frozen=True, kw_only=True)
class ConvertSettings:
    """Settings of the command."""

    fps: float | None = setting(None, above=0)
    """Frames per second of the output; None: of the input."""
    start_s: float = setting(0.0, minimum=0)
    """Where to start in the input."""
    end_s: float | None = setting(None, above=0)
    """Where to end; None: at its end."""
    num_dofs: int | None = setting(None, choices=SHIPPED_NUM_DOFS)
    """Of the humanoid; None: the one whose bodies the input names, else 28."""
    mapping: str = setting("")
    """For a BVH file: a shipped mapping or a YAML file."""
    overwrite: bool = setting(False)
    """Whether an existing output is replaced."""


def convert(source: str, out: str, settings: ConvertSettings) -> Path:
    """Convert one clip; returns the path of the output.

    Raises:
        UserError: the input cannot be read, the output cannot be written, or exists. No partial
            output remains.
    """
    path = Path(out)
    check_output(path, _FORMATS, settings.overwrite)
    if Path(source).suffix.lower() == ".bvh":
        skeleton = skeleton_for_num_dofs(settings.num_dofs or SHIPPED_NUM_DOFS[0])
        mapping = load_mapping(_needed_mapping(settings))
        times = (settings.start_s, settings.end_s, settings.fps)
        clip = retarget_bvh(source, mapping, skeleton, *times)
    else:
        if settings.mapping:
            raise ConfigError(f"mapping={settings.mapping}: only a .bvh file needs one")
        skeletons = [skeleton_for_num_dofs(settings.num_dofs)] if settings.num_dofs else ()
        clip, skeleton = load_single_clip(source, skeletons)
        clip = cut(clip, settings.start_s, settings.end_s)
        if settings.fps is not None:
            clip = resample(clip, settings.fps, skeleton)
    _FORMATS[path.suffix].save(path, clip, skeleton)
    _log.info(
        "%s: %d frames at %g Hz, %.2f s, %d degrees of freedom; lost: %s",
        path,
        clip.num_frames,
        clip.fps,
        clip.length_s,
        skeleton.num_dofs,
        _FORMATS[path.suffix].lost,
    )
    return path


def _needed_mapping(settings: ConvertSettings) -> str:
    if not settings.mapping:
        raise ConfigError(
            f"a .bvh file needs mapping=, one of {', '.join(shipped_mappings())} or a YAML file"
        )
    return settings.mapping


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m isaacgymenvs_lite.motion.convert", description=__doc__
    )
    parser.add_argument("source", metavar="IN", help="the clip to read")
    parser.add_argument("out", metavar="OUT", help="the file to write")
    files = argparse.Namespace()
    return run_command(
        parser,
        ConvertSettings,
        lambda settings: convert(files.source, files.out, settings),
        arguments,
        files,
    )


if __name__ == "__main__":
    sys.exit(main())
