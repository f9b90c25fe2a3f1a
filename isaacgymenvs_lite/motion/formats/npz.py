"""The clip format of this project: a numpy .npz archive of plain arrays, without pickles.

docs/motion_formats.md describes the keys.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError, one_line
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.files import written_clip

_FORMAT = "isaacgymenvs_lite.motion"
_VERSION = 1
_FLOAT_KEYS = ("local_translation", "local_rotation", "root_translation")
_NEEDED_KEYS = ("fps", "body_names", "parent_indices", *_FLOAT_KEYS)
_VELOCITY_KEYS = ("linear_velocity_w", "angular_velocity_w")
# What numpy and the archive reader raise for a damaged file or another format.
_READ_ERRORS = (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)


def save_npz(path: str | Path, clip: MotionClip) -> Path:
    """Write a clip; `.npz` is added to `path` where it is missing.

    The bytes depend on the clip only (no time stamps), and a file of the same name is replaced in
    one step.

    Returns:
        The path of the file.

    Raises:
        MotionFileError: the clip itself is not valid, or the file cannot be written.
    """
    clip.validate()
    path = Path(path)
    if path.suffix != ".npz":
        path = path.with_name(path.name + ".npz")
    with written_clip(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(
            stream,
            format=np.array(_FORMAT),
            version=np.array(_VERSION),
            fps=np.array(clip.fps, dtype=np.float64),
            body_names=np.array(clip.body_names),
            parent_indices=np.array(clip.parent_indices, dtype=np.int64),
            local_translation=clip.local_translation,
            local_rotation=clip.local_rotation,
            root_translation=clip.root_translation,
            linear_velocity_w=clip.linear_velocity_w,
            angular_velocity_w=clip.angular_velocity_w,
        )
    return path


def load_npz(path: str | Path) -> MotionClip:
    """Read a clip; velocities that the file does not hold are computed from its poses.

    Raises:
        MotionFileError: the file is damaged, is no clip, is of a newer version, or holds a clip
            that is not valid.
    """
    arrays = _read_arrays(Path(path))
    _check_keys(arrays, path)
    for key in (*_FLOAT_KEYS, *_VELOCITY_KEYS):
        if key in arrays:
            _check_kind(arrays[key], key, "f", path)
    _check_kind(arrays["body_names"], "body_names", "U", path)
    _check_kind(arrays["parent_indices"], "parent_indices", "iu", path)
    _check_kind(arrays["fps"], "fps", "fiu", path)
    if arrays["fps"].size != 1:
        raise MotionFileError(f"{path}: fps has shape {arrays['fps'].shape}, expected one number")
    names = tuple(str(name) for name in arrays["body_names"].ravel())
    parents = tuple(int(parent) for parent in arrays["parent_indices"].ravel())
    fps = float(arrays["fps"].item())
    poses = {key: arrays[key] for key in _FLOAT_KEYS}
    if any(key not in arrays for key in _VELOCITY_KEYS):
        return MotionClip.from_poses(str(path), fps, names, parents, **poses)
    velocities = {key: arrays[key] for key in _VELOCITY_KEYS}
    clip = MotionClip(str(path), fps, names, parents, **poses, **velocities)
    clip.validate()
    return clip


def _read_arrays(path: Path) -> dict[str, npt.NDArray]:
    if not path.is_file():
        raise MotionFileError(f"{path}: no such file")
    try:
        with path.open("rb") as stream:
            archive = np.load(stream, allow_pickle=False)
            if isinstance(archive, np.ndarray):
                raise MotionFileError(
                    f"{path}: holds a single array (.npy), expected an .npz archive"
                )
            return {key: archive[key] for key in archive.files}
    except _READ_ERRORS as error:
        if isinstance(error, MotionFileError):
            raise
        raise MotionFileError(
            f"{path}: is no readable .npz archive of plain arrays ({one_line(error)}); "
            "expected a clip written by isaacgymenvs_lite.motion.formats.npz.save_npz"
        ) from error


def _check_keys(arrays: dict[str, npt.NDArray], path: str | Path) -> None:
    missing = [key for key in _NEEDED_KEYS if key not in arrays]
    if missing:
        raise MotionFileError(
            f"{path}: lacks {', '.join(missing)}; found {', '.join(sorted(arrays)) or 'nothing'}; "
            "docs/motion_formats.md lists the keys of a clip"
        )
    version = arrays.get("version", np.array(_VERSION))
    if version.size != 1 or version.item() != _VERSION:
        raise MotionFileError(
            f"{path}: is a clip of format version {version}, this program reads {_VERSION}"
        )


def _check_kind(array: npt.NDArray, key: str, kinds: str, path: str | Path) -> None:
    words = {"f": "floats", "U": "strings", "iu": "integers", "fiu": "numbers"}
    if array.dtype.kind not in kinds:
        raise MotionFileError(f"{path}: {key} holds {array.dtype}, expected {words[kinds]}")
