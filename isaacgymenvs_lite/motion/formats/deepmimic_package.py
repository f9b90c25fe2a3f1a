"""DeepMimic's clips in the package pybullet_data: their names, and data sets made of them.

The package is looked up, not imported: importing pybullet is not needed.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import NamedTuple

from isaacgymenvs_lite.errors import MotionFileError, suggest

PREFIX = "deepmimic:"
_PACKAGE = "pybullet_data"
# The clips of humanoids; the folder has a dog as well.
_PACKAGE_FOLDERS = {"": "humanoid3d_*.txt", "walker": "*.txt"}
_SHORT_FOR = "humanoid3d_"

_KINDS = {
    "walk": ("humanoid3d_walk", "walker/0walk_forward"),
    "turn": tuple(f"walker/turn_{side}{number}" for side in ("left", "right") for number in (0, 1)),
    "run": ("humanoid3d_run",),
    "jump": ("humanoid3d_jump",),
    "crawl": ("humanoid3d_crawl",),
    "get up": ("humanoid3d_getup_facedown", "humanoid3d_getup_faceup"),
    "acrobatics": (
        "humanoid3d_backflip",
        "humanoid3d_cartwheel",
        "humanoid3d_roll",
        "humanoid3d_spin",
    ),
    "strike": ("humanoid3d_kick", "humanoid3d_punch", "humanoid3d_spinkick"),
    "dance": ("humanoid3d_dance_a", "humanoid3d_dance_b"),
}
_KIND_OF = {clip: kind for kind, clips in _KINDS.items() for clip in clips}
# The gaits with a steady speed on two feet: jump starts and ends at rest.
_LOCOMOTION = ("walk", "turn", "run")
_LOCOMOTION_SET, _ALL_SET = "locomotion", "all"


class PackageClip(NamedTuple):
    """A clip of the package.

    Attributes:
        name: its full name, such as `deepmimic:humanoid3d_walk`.
        path: its file.
        weight: how often to sample it; the weights of one data set have the sum 1.
    """

    name: str
    path: Path
    weight: float


def is_package_name(motion_file: str | Path) -> bool:
    """Return whether `motion_file` names a clip or a data set of the package."""
    return str(motion_file).startswith(PREFIX)


def clips_in_package() -> list[str]:
    """Return the full names of all clips, such as `deepmimic:humanoid3d_walk`.

    Raises:
        MotionFileError: the package is not installed.
    """
    return [PREFIX + name for name in _paths_of_clips(PREFIX + _ALL_SET)]


def find_in_package(motion_file: str) -> list[PackageClip]:
    """Return the clip, or the clips of the data set, with the name `deepmimic:<name>`.

    `walk` is short for `humanoid3d_walk`; the clips of the folder walker are `walker/turn_left0`.
    The data set `locomotion` holds walking, turning and running, `all` every clip. In a data set
    all kinds of movement have the same weight, and the clips of a kind share it: neither long
    clips nor kinds with many clips outweigh the others. A clip of unknown kind is its own kind.

    Raises:
        MotionFileError: the package is not installed, or has no such clip or data set.
    """
    name = motion_file.removeprefix(PREFIX)
    paths = _paths_of_clips(motion_file)
    gaits = [clip for kind in _LOCOMOTION for clip in _KINDS[kind]]
    if name in (_ALL_SET, _LOCOMOTION_SET):
        names = list(paths) if name == _ALL_SET else gaits
        kinds = [_KIND_OF.get(clip, clip) for clip in names]
        missing = [clip for clip in names if clip not in paths]
        if missing:
            raise MotionFileError(
                f"'{motion_file}': the installed {_PACKAGE} lacks {', '.join(missing)}; "
                "pybullet 3.2.7 has all clips"
            )
        return [
            PackageClip(PREFIX + clip, paths[clip], 1.0 / (len(set(kinds)) * kinds.count(kind)))
            for clip, kind in zip(names, kinds, strict=True)
        ]
    for full_name in (name, _SHORT_FOR + name):
        if full_name in paths:
            return [PackageClip(PREFIX + full_name, paths[full_name], 1.0)]
    known = [_ALL_SET, _LOCOMOTION_SET, *paths, *(clip.removeprefix(_SHORT_FOR) for clip in paths)]
    raise MotionFileError(
        f"unknown DeepMimic clip or data set '{name}'{suggest(name, known)}; "
        f"data sets: {_ALL_SET}, {_LOCOMOTION_SET}; clips: {', '.join(paths)}"
    )


def _paths_of_clips(motion_file: str) -> dict[str, Path]:
    """Return the files of all clips by their full names without prefix, sorted."""
    spec = importlib.util.find_spec(_PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise MotionFileError(
            f"'{motion_file}' belongs to the package {_PACKAGE}, which is not installed; "
            'pip install "isaacgymenvs-lite[motions]"'
        )
    folder = Path(spec.submodule_search_locations[0]) / "data" / "motions"
    paths = {
        path.relative_to(folder).with_suffix("").as_posix(): path
        for sub, pattern in _PACKAGE_FOLDERS.items()
        for path in (folder / sub).glob(pattern)
    }
    return dict(sorted(paths.items()))
