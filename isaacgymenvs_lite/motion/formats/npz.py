"""This project's clip format, a numpy .npz archive of plain arrays without pickled objects.

docs/motion_formats.md describes the arrays in the archive.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.files import native_floats, reading, written_clip

_FORMAT = "isaacgymenvs_lite.motion"
VERSION = 1
_FLOAT_KEYS = ("local_translation", "local_rotation", "root_translation")
_OPTIONAL_KEYS = ("dof_pos",)
_NEEDED_KEYS = ("fps", "body_names", "parent_indices", *_FLOAT_KEYS)
_VELOCITY_KEYS = ("linear_velocity_w", "angular_velocity_w")
_KNOWN_KEYS = ("version", *_NEEDED_KEYS, *_VELOCITY_KEYS, *_OPTIONAL_KEYS)
_EXPECTED = ".npz archive of plain arrays (see motion.formats.npz.save_npz)"


def save_npz(path: str | Path, clip: MotionClip) -> Path:
    """Write a clip and return the file's path; `.npz` is added if `path` has another suffix.

    The file's bytes depend only on the clip. An existing file is replaced in one step.
    """
    clip.validate()
    arrays = {
        "body_names": np.array(clip.body_names),
        "parent_indices": np.array(clip.parent_indices, dtype=np.int64),
        **{key: getattr(clip, key) for key in (*_FLOAT_KEYS, *_VELOCITY_KEYS)},
        **({} if clip.dof_pos is None else {"dof_pos": clip.dof_pos}),
    }
    return write_arrays(path, _FORMAT, clip.fps, arrays)


def write_arrays(
    path: str | Path, kind: str, fps: float, arrays: Mapping[str, npt.NDArray]
) -> Path:
    """Write arrays to an archive with the format name `kind`; see `save_npz`."""
    path = Path(path)
    if path.suffix != ".npz":
        path = path.with_name(path.name + ".npz")
    with written_clip(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(
            stream,
            format=np.array(kind),
            version=np.array(VERSION),
            fps=np.array(fps, dtype=np.float64),
            **dict[str, Any](arrays),
        )
    return path


def load_npz(path: str | Path) -> MotionClip:
    """Read a clip; velocities that the file does not contain are computed from the poses."""
    with reading(path, _EXPECTED):
        arrays = read_arrays(path, _KNOWN_KEYS)
        missing = [key for key in _NEEDED_KEYS if key not in arrays]
        if missing:
            found = ", ".join(sorted(arrays)) or "nothing"
            raise MotionFileError(
                f"{path}: lacks {', '.join(missing)}; found {found}; docs/motion_formats.md lists"
                " the keys of a clip"
            )
        check_version(arrays, path)
        kinds = {"body_names": "U", "parent_indices": "iu"}
        for key, array in arrays.items():
            if key not in ("version", "fps"):
                check_kind(array, key, kinds.get(key, "f"), path)
        names = tuple(str(name) for name in arrays["body_names"].ravel())
        parents = tuple(int(parent) for parent in arrays["parent_indices"].ravel())
        fps = one_number(arrays["fps"], "fps", path)
        stored = [key for key in (*_FLOAT_KEYS, *_OPTIONAL_KEYS) if key in arrays]
        poses = {key: native_floats(arrays[key]) for key in stored}
        if any(key not in arrays for key in _VELOCITY_KEYS):
            return MotionClip.from_poses(str(path), fps, names, parents, **poses)
        velocities = {key: native_floats(arrays[key]) for key in _VELOCITY_KEYS}
        clip = MotionClip(str(path), fps, names, parents, **poses, **velocities)
        clip.validate()
        return clip


def read_arrays(path: str | Path, keys: Iterable[str]) -> dict[str, npt.NDArray]:
    """Return the arrays of an archive that `keys` names; other arrays are not unpacked.

    Call this function within `reading`, because a damaged archive may raise any exception.
    """
    with opened(path) as archive:
        return {key: archive[key] for key in keys if key in archive.files}


def opened(path: str | Path) -> np.lib.npyio.NpzFile:
    """Open an archive of arrays; call this function within `reading`."""
    archive = np.load(path, allow_pickle=False)
    if isinstance(archive, np.ndarray):
        raise MotionFileError(f"{path}: holds a single array (.npy), expected an .npz archive")
    return archive


def check_kind(array: npt.NDArray, key: str, kinds: str, path: str | Path) -> None:
    """Raise a MotionFileError if the numpy kind of an array is not in `kinds`."""
    words = {"f": "floats", "U": "strings", "iu": "integers", "fiu": "numbers"}
    if array.dtype.kind not in kinds:
        raise MotionFileError(f"{path}: {key} holds {array.dtype}, expected {words[kinds]}")


def one_number(array: npt.NDArray, key: str, path: str | Path) -> float:
    """Return the only value of an array; raise a MotionFileError if it has several values."""
    check_kind(array, key, "fiu", path)
    if array.size != 1:
        raise MotionFileError(f"{path}: {key} has shape {array.shape}, expected one number")
    return float(array.item())


def check_version(arrays: Mapping[str, npt.NDArray], path: str | Path) -> None:
    """Raise a MotionFileError for a clip in another version of this project's format."""
    version = arrays.get("version", np.array(VERSION))
    if version.size != 1 or version.item() != VERSION:
        raise MotionFileError(
            f"{path}: is a clip of format version {version}, this program reads {VERSION}"
        )
