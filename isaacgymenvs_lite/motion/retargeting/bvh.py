"""Reads motion capture in the BVH format with the library pybvh.

Many programs write position channels for all joints, not for the root alone; pybvh cannot read
them. Where they do not change they are the joint's offset, or zero: `drop_inner_positions` removes
them without loss.
"""

from __future__ import annotations

import re
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import MotionFileError, one_line
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.files import read_bytes, reading
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations
from isaacgymenvs_lite.utils.optional_packages import import_package

_MAX_BYTES = 2**25
# Of the hierarchy. A rig with fingers has 80 joints and lines of 100 characters.
_MAX_HEADER_LINES, _MAX_HEADER_LENGTH = 10_000, 1_000
_MAX_FRAMES = 1_000_000
# What it reads in place of the file, and how its messages name that.
_COPY = "motion.bvh"
_PLACE = re.compile(rf" in (file )?\S*{re.escape(_COPY)}")
# A joint may move in its parent by this part of the longest bone: rounding, and markers' noise.
_TOLERANCE = 0.01
_JOINT = re.compile(r"^\s*(ROOT|JOINT)\s+(.*\S)")
_CHANNELS = re.compile(r"^(\s*)CHANNELS\s+\d+\s+(.*\S)", re.IGNORECASE)
_OFFSET = re.compile(r"^(\s*)OFFSET\s+(.*\S)", re.IGNORECASE)
_AXES = ("Xposition", "Yposition", "Zposition")


def load_bvh(path: str | Path, to_z_up: FloatArray, unit_m: float) -> MotionClip:
    """Read a BVH file as a clip of its own skeleton, in our axes and in metres.

    Args:
        path: of the file. Its root has three position and three rotation channels, in any order;
            all other joints have three rotation channels, and positions if these stay the same.
        to_z_up: (4,) xyzw, the rotation from the axes of the file to ours, z up.
        unit_m: m per unit of length of the file.

    Raises:
        MissingPackageError: pybvh is not installed.
        MotionFileError: the file is missing, truncated, damaged or is no BVH file; a number is NaN
            or infinite; there are fewer than two frames.
    """
    pybvh = import_package("pybvh", "reading BVH files")
    with reading(path, "BVH file"):
        return _clip(pybvh, Path(path), to_z_up, unit_m)


def bvh_joint_names(path: str | Path) -> list[str]:
    """Return the names of the joints of a BVH file; its frames are not read.

    Raises:
        MotionFileError: the file is missing, too long, or has no joints.
    """
    with reading(path, "BVH file"):
        text = read_bytes(path, _MAX_BYTES).decode("utf-8", errors="replace")
        _check_size(text)
        header = text.partition("MOTION")[0].splitlines()
        names = [match[2] for line in header if (match := _JOINT.match(line))]
        if not names:
            raise ValueError("it has no joints")
        return names


def _clip(pybvh: Any, path: Path, to_z_up: FloatArray, unit_m: float) -> MotionClip:
    text = read_bytes(path, _MAX_BYTES).decode("utf-8", errors="replace")
    _check_size(text)
    try:
        motion, root, wxyz = _parse(pybvh, drop_inner_positions(text, str(path)))
    except ValueError as error:
        if isinstance(error, MotionFileError):
            raise
        raise ValueError(_PLACE.sub("", one_line(error))) from error
    joints = [node for node in motion.nodes if not node.is_end_site()]
    offsets = np.array([node.offset for node in joints], dtype=np.float64)
    _check_numbers(path, root, wxyz, offsets)
    turns = rotations.xyzw_from_wxyz(torch.from_numpy(wxyz))
    up = torch.from_numpy(to_z_up)
    turns[:, 0] = rotations.quat_mul(up.expand(len(turns), 4), turns[:, 0])
    places = rotations.quat_apply(up.expand(len(root), 4), torch.from_numpy(root))
    names = [node.name for node in joints]
    parents = [names.index(node.parent.name) if node.parent else -1 for node in joints]
    return MotionClip.from_poses(
        str(path),
        1.0 / motion.frame_time,
        names,
        parents,
        offsets * unit_m,
        turns.numpy(),
        places.numpy() * unit_m,
    )


def _parse(pybvh: Any, text: str) -> tuple[Any, FloatArray, FloatArray]:
    """Return the library's motion, root positions (T, 3) and rotations (T, J, 4) wxyz."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # A file without frames is an error later; numpy's warning of it would be a second line.
        warnings.simplefilter("ignore")
        copy = Path(folder) / _COPY  # the library reads files only
        copy.write_text(text, encoding="utf-8")
        # The mapping gives the axis that points up.
        motion = pybvh.read_bvh_file(copy, world_up="+y")
        return motion, *motion.to_quat()


def _check_size(text: str) -> None:
    """Refuse texts that would take long, before they are searched and read.

    Raises:
        ValueError: there are more joints, longer names or more frames than motion capture has.
    """
    header, _, frames = text.partition("MOTION")
    lines = header.splitlines()
    longest = max(map(len, lines), default=0)
    if len(lines) > _MAX_HEADER_LINES or longest > _MAX_HEADER_LENGTH:
        raise ValueError(
            f"its hierarchy has {len(lines)} lines of up to {longest} characters, expected at most "
            f"{_MAX_HEADER_LINES} and {_MAX_HEADER_LENGTH}"
        )
    if frames.count("\n") + frames.count("\r") > _MAX_FRAMES:
        raise ValueError(f"it has more than {_MAX_FRAMES:,} lines of frames")


def _check_numbers(path: Path, *arrays: FloatArray) -> None:
    if not all(np.isfinite(array).all() for array in arrays):
        raise MotionFileError(f"{path}: holds numbers that are NaN or infinite")


@dataclass(frozen=True)
class _Joint:
    """A joint of the hierarchy.

    Attributes:
        name: as in the file.
        is_root: whether it has no parent.
        offset_line: number of its OFFSET line.
        channels_line: number of its CHANNELS line.
        channels: their names.
        first_column: of the frames.
    """

    name: str
    is_root: bool
    offset_line: int
    channels_line: int
    channels: tuple[str, ...]
    first_column: int

    def columns(self, names: tuple[str, ...]) -> list[int]:
        """Return the columns of those channels with these names that exist."""
        found = [name.lower() for name in self.channels]
        return [
            self.first_column + found.index(name.lower()) for name in names if name.lower() in found
        ]


def drop_inner_positions(text: str, name: str) -> str:
    """Return the text of a BVH file without position channels of joints other than the root.

    A text without such channels is returned unchanged, and so is one that is no BVH file: its
    reader reports what is wrong.

    Args:
        text: of the file.
        name: of the file, for messages.

    Raises:
        MotionFileError: a joint moves within its parent.
        ValueError: there are no frames, or one has not as many numbers as there are channels.
    """
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip() == "MOTION"), None)
    joints = _joints(lines[:start]) if start is not None else []
    inner = [joint for joint in joints if not joint.is_root and joint.columns(_AXES)]
    if start is None or not inner:
        return text
    first = start + 3  # behind "Frames:" and "Frame Time:"
    if not any(map(str.strip, lines[first:])):
        raise ValueError("there are no frames behind 'MOTION', 'Frames:' and 'Frame Time:'")
    values = np.loadtxt(lines[first:], comments=None, ndmin=2)
    expected = sum(len(joint.channels) for joint in joints)
    if values.shape[1] != expected:
        raise ValueError(f"the joints have {expected} channels, the frames another number")
    offsets = {joint.name: _numbers(lines[joint.offset_line]) for joint in joints}
    tolerance = _TOLERANCE * max(float(np.linalg.norm(offset)) for offset in offsets.values())
    for joint in inner:
        columns = joint.columns(_AXES)
        place = _constant_place(values[:, columns], tolerance, f"{name}: joint {joint.name}")
        if np.abs(place).max() > tolerance:
            offset = offsets[joint.name]
            offset[[i for i, axis in enumerate(_AXES) if joint.columns((axis,))]] = place
            lines[joint.offset_line] = "OFFSET " + " ".join(f"{x:.9g}" for x in offset)
        turns = [channel for channel in joint.channels if "position" not in channel.lower()]
        lines[joint.channels_line] = f"CHANNELS {len(turns)} {' '.join(turns)}"
    dropped = [column for joint in inner for column in joint.columns(_AXES)]
    kept = np.delete(values, dropped, axis=1)
    frames = [" ".join(f"{x:.9g}" for x in row) for row in kept]
    return "\n".join([*lines[:first], *frames, ""])


def _joints(header: list[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    name, is_root, offset_line, column = "", False, 0, 0
    for number, line in enumerate(header):
        if found := _JOINT.match(line):
            name, is_root = found[2], found[1] == "ROOT"
        elif _OFFSET.match(line) and name:
            offset_line = number
        elif found := _CHANNELS.match(line):
            channels = tuple(found[2].split())
            joints.append(_Joint(name, is_root, offset_line, number, channels, column))
            column += len(channels)
            name = ""  # the offset of the next end site is not this joint's
    return joints


def _numbers(offset: str) -> npt.NDArray[np.float64]:
    return np.array(offset.split()[1:], dtype=np.float64)


def _constant_place(
    places: npt.NDArray[np.float64], tolerance: float, joint: str
) -> npt.NDArray[np.float64]:
    """Return the place (C,) of a joint in its parent, the mean over its places (T, C)."""
    spread = float(np.ptp(places, axis=0).max())
    if spread > 2.0 * tolerance:
        raise MotionFileError(
            f"{joint} moves within its parent by {spread:.3g} units; limbs that change their length"
            " cannot be followed, write the file with position channels of the root only"
        )
    return places.mean(axis=0)
