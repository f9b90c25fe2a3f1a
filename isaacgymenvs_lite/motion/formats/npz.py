"""The clip format of this project: a numpy .npz archive of plain arrays, without pickles.

docs/motion_formats.md describes the keys.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MAX_BODIES, MotionClip
from isaacgymenvs_lite.motion.formats.files import (
    MAX_BINARY_BYTES,
    check_text,
    native_floats,
    read_bytes,
    reading,
    written_clip,
)

_FORMAT = "isaacgymenvs_lite.motion"
_VERSION = 1
_FLOAT_KEYS = ("local_translation", "local_rotation", "root_translation")
_OPTIONAL_KEYS = ("dof_pos",)
_NEEDED_KEYS = ("fps", "body_names", "parent_indices", *_FLOAT_KEYS)
_VELOCITY_KEYS = ("linear_velocity_w", "angular_velocity_w")
_KNOWN_KEYS = ("format", "version", *_NEEDED_KEYS, *_VELOCITY_KEYS, *_OPTIONAL_KEYS)
_MAX_MEMBERS = 10_000
_MEMBER_SIGNATURE = b"PK\1\2"
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # what numpy writes
_HEADER_READERS: dict[tuple[int, int], Any] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_EXPECTED = ".npz archive of plain arrays, as motion.formats.npz.save_npz writes it,"


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
    joints: dict[str, Any] = {} if clip.dof_pos is None else {"dof_pos": clip.dof_pos}
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
            **joints,
        )
    return path


def load_npz(path: str | Path) -> MotionClip:
    """Read a clip; velocities that the file does not hold are computed from its poses.

    Raises:
        MotionFileError: the file is damaged, is no clip, is of a newer version, or holds a clip
            that is not valid.
    """
    with reading(path, _EXPECTED):
        return _clip(read_arrays(path, _KNOWN_KEYS), path)


def _clip(arrays: dict[str, npt.NDArray], path: str | Path) -> MotionClip:
    _check_keys(arrays, path)
    for key in (*_FLOAT_KEYS, *_VELOCITY_KEYS, *_OPTIONAL_KEYS):
        if key in arrays:
            check_kind(arrays[key], key, "f", path)
    check_kind(arrays["body_names"], "body_names", "U", path, MAX_BODIES)
    check_kind(arrays["parent_indices"], "parent_indices", "iu", path, MAX_BODIES)
    check_kind(arrays["fps"], "fps", "fiu", path)
    if arrays["fps"].size != 1:
        raise MotionFileError(f"{path}: fps has shape {arrays['fps'].shape}, expected one number")
    names = tuple(str(name) for name in arrays["body_names"].ravel())
    parents = tuple(int(parent) for parent in arrays["parent_indices"].ravel())
    fps = float(arrays["fps"].item())
    stored = [key for key in (*_FLOAT_KEYS, *_OPTIONAL_KEYS) if key in arrays]
    poses = {key: native_floats(arrays[key]) for key in stored}
    if any(key not in arrays for key in _VELOCITY_KEYS):
        return MotionClip.from_poses(str(path), fps, names, parents, **poses)
    velocities = {key: native_floats(arrays[key]) for key in _VELOCITY_KEYS}
    clip = MotionClip(str(path), fps, names, parents, **poses, **velocities)
    clip.validate()
    return clip


def read_arrays(path: str | Path, keys: Collection[str]) -> dict[str, npt.NDArray]:
    """Return those arrays of an archive that `keys` names; other members are not unpacked.

    Works within `reading`: a damaged archive raises anything, one that is too large a
    MotionFileError.
    """
    with _opened(Path(path)) as archive:
        members: dict[str, zipfile.ZipInfo] = {}
        for member in archive.infolist():
            key = member.filename.removesuffix(".npy")
            if key in members and key in keys:
                raise ValueError(f"two arrays of the name {key}")
            members[key] = member
        members = {key: members[key] for key in keys if key in members}
        if sum(member.file_size for member in members.values()) > MAX_BINARY_BYTES:
            size = MAX_BINARY_BYTES // 2**20
            raise MotionFileError(f"{path}: its arrays promise more than {size} MiB")
        return {key: _read_array(archive, member) for key, member in members.items()}


def array_names(path: str | Path) -> set[str]:
    """Return the names of the arrays of an archive without reading them; see `read_arrays`."""
    with _opened(Path(path)) as archive:
        return {name.removesuffix(".npy") for name in archive.namelist()}


def _opened(path: Path) -> zipfile.ZipFile:
    content = read_bytes(path, MAX_BINARY_BYTES)
    if content.startswith(np.lib.format.MAGIC_PREFIX):
        raise MotionFileError(f"{path}: holds a single array (.npy), expected an .npz archive")
    if content.count(_MEMBER_SIGNATURE) > _MAX_MEMBERS:
        raise ValueError(f"an archive of more than {_MAX_MEMBERS:,} members")
    return zipfile.ZipFile(io.BytesIO(content))


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray:
    """Return the array of one member; ValueError if its header promises what it does not hold."""
    if member.compress_type not in _METHODS:
        raise ValueError(f"{member.filename} is compressed in another way than numpy does it")
    with archive.open(member) as stream:
        # With a size: read() alone would unpack whatever the member holds, up to 2 GiB.
        content = io.BytesIO(stream.read(member.file_size))
    version = np.lib.format.read_magic(content)
    if version not in _HEADER_READERS:
        raise ValueError(f"{member.filename} has a header of version {version}")
    shape, _, dtype = _HEADER_READERS[version](content)
    left = len(content.getbuffer()) - content.tell()
    if dtype.hasobject:
        raise ValueError(f"{member.filename} holds objects, which only a pickle can make")
    # An array whose items have no size can have any number of them.
    if not dtype.itemsize or math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"{member.filename} promises {dtype} of shape {shape} in {left} bytes")
    content.seek(0)
    array = np.lib.format.read_array(content, allow_pickle=False)
    if array.dtype.kind == "U":
        check_text(array)
    return array


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


def check_kind(
    array: npt.NDArray, key: str, kinds: str, path: str | Path, most: int | None = None
) -> None:
    """Raise a MotionFileError for an array of other than the expected numpy kinds.

    `most`: how many items it may have; each becomes an object of Python, or a wider number.
    """
    words = {"f": "floats", "U": "strings", "iu": "integers", "fiu": "numbers"}
    if array.dtype.kind not in kinds:
        raise MotionFileError(f"{path}: {key} holds {array.dtype}, expected {words[kinds]}")
    if most is not None and array.size > most:
        raise MotionFileError(
            f"{path}: {key} holds {array.size:,} {words[kinds]}, expected at most {most:,}"
        )
