"""BVH files that give every joint a position: what the reader's library cannot read, it is spared.

Many programs write position channels for all joints, not for the root alone. Where those do not
change, they are the joint's offset, or zero; the file says the same without them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError

# A joint may move in its parent by this part of the longest bone: rounding, and markers' noise.
_TOLERANCE = 0.01
_JOINT = re.compile(r"^\s*(ROOT|JOINT)\s+(.*\S)")
_CHANNELS = re.compile(r"^(\s*)CHANNELS\s+\d+\s+(.*\S)", re.IGNORECASE)
_OFFSET = re.compile(r"^(\s*)OFFSET\s+(.*\S)", re.IGNORECASE)
_AXES = ("Xposition", "Yposition", "Zposition")


@dataclass(frozen=True)
class _Joint:
    """A joint of the hierarchy.

    Attributes:
        name: as the file says.
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
        """Return the columns of the channels with these names, those of them that there are."""
        found = [name.lower() for name in self.channels]
        return [
            self.first_column + found.index(name.lower()) for name in names if name.lower() in found
        ]


def drop_inner_positions(text: str, name: str) -> str:
    """Return the text of a BVH file without position channels of joints other than the root.

    A text without such channels is returned as it is, and so is one that is no BVH file: reading it
    tells what is wrong.

    Args:
        text: of the file.
        name: of the file, for messages.

    Raises:
        MotionFileError: a joint moves within its parent.
        ValueError: a frame is not made of as many numbers as there are channels.
    """
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip() == "MOTION"), None)
    joints = _joints(lines[:start]) if start is not None else []
    inner = [joint for joint in joints if not joint.is_root and joint.columns(_AXES)]
    if start is None or not inner:
        return text
    first = start + 3  # behind "Frames:" and "Frame Time:"
    rows = [line.split() for line in lines[first:] if line.strip()]
    values = np.array(rows, dtype=np.float64)
    expected = sum(len(joint.channels) for joint in joints)
    if values.ndim != 2 or values.shape[1] != expected:
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
            name = ""  # the offset of an end site that follows is not its own
    return joints


def _numbers(offset: str) -> npt.NDArray[np.float64]:
    return np.array(offset.split()[1:], dtype=np.float64)


def _constant_place(
    places: npt.NDArray[np.float64], tolerance: float, joint: str
) -> npt.NDArray[np.float64]:
    """Return the place (C,) of a joint in its parent, from what all frames (T, C) say of it."""
    spread = float(np.ptp(places, axis=0).max())
    if spread > 2.0 * tolerance:
        raise MotionFileError(
            f"{joint} moves within its parent by {spread:.3g} units; limbs that change their length"
            " cannot be followed, write the file with position channels of the root only"
        )
    return places.mean(axis=0)
