"""Reads motion capture files in the BVH format with the library pybvh.

pybvh reads position channels only for the joint ROOT. Many programs write position channels for all
joints, or move the hips below a fixed ROOT; `_split_positions` removes these channels from the
text. The positions of ROOT and of the joints down to the hips determine the position of the clip's
root. Other joints must have constant positions.
"""

from __future__ import annotations

import itertools
import re
import tempfile
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError, one_line
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations
from isaacgymenvs_lite.utils.optional_packages import import_package

# Name of the temporary file that pybvh reads, and a pattern that finds the name in pybvh's
# messages.
_COPY = "motion.bvh"
_PLACE = re.compile(rf" in (file )?\S*{re.escape(_COPY)}")
# Largest change of a joint position that counts as constant, as a share of the longest bone.
_TOLERANCE = 0.01
_JOINT = re.compile(r"^\s*(?:ROOT|JOINT)\s+(.*?)\s*\{?\s*$")
_CHANNELS = re.compile(r"^\s*CHANNELS\s+\d+(.*)", re.IGNORECASE)
_POSITIONS = ("Xposition", "Yposition", "Zposition")
_ROTATIONS = ("Zrotation", "Yrotation", "Xrotation")


@dataclass(frozen=True, eq=False)
class BvhMotion:
    """T frames of a skeleton with J joints, in the axes and the length unit of the BVH file."""

    name: str  # path of the file
    fps: float  # frames per second
    joint_names: tuple[str, ...]  # J names; parents come first
    parent_indices: tuple[int, ...]  # J ids, -1 for the root
    offsets: FloatArray  # (J, 3), positions in the parents' frames (row 0 is not used)
    turns: FloatArray  # (T, J, 4) xyzw, rotations relative to the parents (root: to the world)
    places: FloatArray  # (T, 3), world positions of the root

    def clip(self, to_z_up: FloatArray, unit_m: float) -> MotionClip:
        """Return the motion as a clip of the file's skeleton, in m and with z up.

        `to_z_up` (4,) xyzw is the rotation from the file's axes to axes with z up.
        """
        up = torch.from_numpy(to_z_up).expand(len(self.turns), 4)
        turns = self.turns.copy()
        turns[:, 0] = rotations.quat_mul(up, torch.from_numpy(turns[:, 0])).numpy()
        places = rotations.quat_apply(up, torch.from_numpy(self.places)).numpy()
        with reading(self.name, "BVH file"):
            skeleton = (self.joint_names, self.parent_indices, self.offsets * unit_m)
            return MotionClip.from_poses(self.name, self.fps, *skeleton, turns, places * unit_m)


@dataclass(frozen=True)
class _Joint:
    """A joint's parent id, index of its CHANNELS line (or -1), and the column of each channel."""

    name: str
    parent: int
    line: int = -1
    columns: Mapping[str, int] = field(default_factory=dict)

    def expected(self) -> tuple[str, ...]:
        """Return the channels that pybvh expects, rotations and (only for ROOT) positions."""
        turns = tuple(channel for channel in self.columns if channel not in _POSITIONS)
        return (*(_POSITIONS if self.parent < 0 else ()), *(turns or _ROTATIONS))


def bvh_hierarchy(path: str | Path) -> tuple[list[str], list[int]]:
    """Return joint names and parent ids in a BVH file; the frames are not read."""
    with reading(path, "BVH file"):
        joints = _joints(_lines(path))
    return [joint.name for joint in joints], [joint.parent for joint in joints]


def read_bvh(path: str | Path, joints: Collection[str] = ()) -> BvhMotion:
    """Read a BVH file whose joints have three rotation channels or none, in any order.

    The lowest joint from which all `joints` descend becomes the root, and its motion includes the
    motion of the joints above it. If `joints` is empty, the root is ROOT.
    """
    pybvh = import_package("pybvh", "reading BVH files")
    with reading(path, "BVH file"):
        lines = _lines(path)
        header = _joints(lines)  # The names come from here, because pybvh cuts names at a space.
        names, parents = [joint.name for joint in header], [joint.parent for joint in header]
        lines, positions = _split_positions(lines, header)
        motion, root, wxyz = _parse(pybvh, "\n".join(lines))
        nodes = [node for node in motion.nodes if not node.is_end_site()]
        offsets = np.array([node.offset for node in nodes], dtype=np.float64)
        if not all(np.isfinite(x).all() for x in (root, wxyz, offsets, *positions.values())):
            raise MotionFileError(f"{path}: holds numbers that are NaN or infinite")
        above = shared_chain(parents, [names.index(joint) for joint in joints if joint in names])
        steps = _places_in_parents(names, offsets, positions, [names[i] for i in above], path)
        turns = rotations.xyzw_from_wxyz(torch.from_numpy(wxyz))
        # If the file has no positions of ROOT, or only zeros, ROOT's position is its offset.
        place = torch.from_numpy(root if root.any() else root + offsets[0])
        turn = turns[:, 0]
        for joint, step in zip(above[1:], steps, strict=True):
            place = place + rotations.quat_apply(turn, torch.from_numpy(step).expand_as(place))
            turn = rotations.quat_mul(turn, turns[:, joint])
        kept = above[-1:]
        kept += [i for i in range(kept[0] + 1, len(names)) if kept[0] in chain(parents, i)]
        turns[:, kept[0]] = turn
        return BvhMotion(
            str(path),
            1.0 / motion.frame_time,
            tuple(names[i] for i in kept),
            (-1, *(kept.index(parents[i]) for i in kept[1:])),
            offsets[kept],
            turns[:, kept].numpy(),
            place.numpy(),
        )


def chain(parents: Sequence[int], joint: int) -> list[int]:
    """Return all joints from the root to `joint`."""
    found = [joint]
    while parents[found[0]] >= 0:
        found.insert(0, parents[found[0]])
    return found


def shared_chain(parents: Sequence[int], joints: Sequence[int]) -> list[int]:
    """Return the joints from the root to the lowest joint from which all `joints` descend."""
    levels = zip(*(chain(parents, joint) for joint in joints), strict=False)
    return [level[0] for level in itertools.takewhile(lambda x: len(set(x)) == 1, levels)] or [0]


def _lines(path: str | Path) -> list[str]:
    return Path(path).read_text(encoding="utf-8", errors="replace").splitlines()


def _joints(lines: Sequence[str]) -> list[_Joint]:
    """Return the joints described before the line MOTION, at least one; parents come first."""
    joints, open_joints, column = list[_Joint](), [-1], 0
    for number, line in enumerate(itertools.takewhile(lambda x: x.strip() != "MOTION", lines)):
        if found := _JOINT.match(line):
            joints.append(_Joint(found[1], open_joints[-1]))
        elif (found := _CHANNELS.match(line)) and joints:
            channels = [channel.capitalize() for channel in found[1].split()]
            columns = {channel: column + i for i, channel in enumerate(channels)}
            joints[-1] = _Joint(joints[-1].name, joints[-1].parent, number, columns)
            column += len(channels)
        for brace in re.findall("[{}]", line):
            if brace == "{":  # A brace opens a joint or an end site.
                open_joints.append(len(joints) - 1)
            elif len(open_joints) > 1:
                open_joints.pop()
    if not joints:
        raise ValueError("it has no joints")
    return joints


def _split_positions(
    lines: list[str], joints: Sequence[_Joint]
) -> tuple[list[str], dict[str, FloatArray]]:
    """Remove position channels of joints below ROOT; return the lines and the positions (T, 3).

    Joints without rotation channels get zero rotations. If the lines do not belong to a BVH file,
    they are returned unchanged, and pybvh then raises an error.
    """
    start = next((i for i, line in enumerate(lines) if line.strip() == "MOTION"), None)
    joints = [joint for joint in joints if joint.line >= 0]
    if start is None or all(set(joint.expected()) == set(joint.columns) for joint in joints):
        return lines, {}
    first = start + 3  # the line after "Frames:" and "Frame Time:"
    if not any(map(str.strip, lines[first:])):
        raise ValueError("there are no frames after 'MOTION', 'Frames:' and 'Frame Time:'")
    values = np.loadtxt(lines[first:], comments=None, ndmin=2)
    width = sum(len(joint.columns) for joint in joints)
    if values.shape[1] != width:
        raise ValueError(f"the joints have {width} channels, the frames {values.shape[1]}")
    values = np.pad(values, ((0, 0), (0, 1)))
    positions, kept, lines = {}, list[int](), lines[:]
    for joint in joints:
        expected = joint.expected()
        kept += [joint.columns.get(channel, width) for channel in expected]
        lines[joint.line] = f"CHANNELS {len(expected)} {' '.join(expected)}"
        if joint.parent >= 0 and _POSITIONS[0] in joint.columns:
            positions[joint.name] = values[:, [joint.columns[channel] for channel in _POSITIONS]]
    frames = [" ".join(f"{x:.9g}" for x in row) for row in values[:, kept]]
    return [*lines[:first], *frames, ""], positions


def _parse(pybvh: Any, text: str) -> tuple[Any, FloatArray, FloatArray]:
    """Return the motion that pybvh reads, root positions (T, 3) and rotations (T, J, 4) wxyz."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # A file without frames is refused later.
        copy = Path(folder) / _COPY
        copy.write_text(text, encoding="utf-8")
        try:
            # pybvh's up axis is ignored, because the mapping determines the up axis.
            motion = pybvh.read_bvh_file(copy, world_up="+y")
            return motion, *motion.to_quat()
        except ValueError as error:
            raise ValueError(_PLACE.sub("", one_line(error))) from error


def _places_in_parents(
    names: Sequence[str],
    offsets: FloatArray,
    positions: Mapping[str, FloatArray],
    above: Sequence[str],
    path: str | Path,
) -> list[FloatArray]:
    """Replace offsets (J, 3) in place by the constant joint positions that are not zero.

    Only the joints listed in `above` (from ROOT to the clip's root) may change their positions
    relative to their parents. Return the positions (T, 3) or (1, 3) of these joints except ROOT.
    """
    tolerance = _TOLERANCE * float(np.linalg.norm(offsets, axis=1).max())
    steps = dict(zip(names, offsets[:, None].copy(), strict=True))
    for name, given in positions.items():
        if np.abs(given).max() <= tolerance:
            continue
        steps[name] = given
        if name not in above:
            spread = float(np.ptp(given, axis=0).max())
            if spread > 2.0 * tolerance:
                raise MotionFileError(
                    f"{path}: joint {name} moves within its parent by {spread:.3g} units, expected "
                    "limbs of constant length; export position channels only for the hips and the "
                    "joints above them"
                )
            offsets[names.index(name)] = given.mean(axis=0)
    return [steps[name] for name in above[1:]]
