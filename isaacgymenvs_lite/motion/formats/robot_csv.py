"""Robots' clips as tables (`.csv`), in three forms, which differ in the first line.

- Without a header: root position (m), root quaternion xyzw, joint angles (rad), 30 fps. Unitree's
  retargeted LAFAN1 has it (README of unitreerobotics/LAFAN1_Retargeting_Dataset on Hugging Face),
  and mjlab and whole_body_tracking read it (scripts/csv_to_npz.py). Kimodo's tables have wxyz
  (convert_g1_csv_to_proto.py, see below).
- BONES-SEED: `Frame`, `root_translateX`, ... in cm, `root_rotateX`, ... in degrees about the fixed
  axes x, y, z in this order, then `left_hip_pitch_joint_dof`, ... in degrees, 120 fps. Layout,
  units and rate are what public converters use (data/scripts/convert_g1_csv_to_proto.py of
  NVlabs/ProtoMotions, scripts/motion/bones_seed_csv_to_npz.py of UniLab, sonic2mimic.py of an
  mjlab fork); the data set itself was not read.
- This project's: the header of formats.joint_csv with the names of any robot's joints.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.files import reading, written_clip
from isaacgymenvs_lite.motion.formats.joint_csv import (
    ANGLE_UNITS,
    COLUMN,
    LENGTH_UNITS,
    MAX_COLUMN_LENGTH,
    MAX_COLUMNS,
    POSITION,
    ROTATION,
    TIME,
    TIME_UNITS,
    frame_rate,
    read_lines,
    read_numbers,
)
from isaacgymenvs_lite.motion.formats.robot_joints import BY_NUMBER
from isaacgymenvs_lite.motion.joint_clip import JointClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

LAFAN1_FPS, BONES_FPS = 30.0, 120.0
_ROOT_WIDTH = 7
_BONES_FRAME = "Frame"
_BONES_POSITION = tuple(f"root_translate{axis}" for axis in "XYZ")
_BONES_ROTATION = tuple(f"root_rotate{axis}" for axis in "XYZ")


def load_robot_csv(path: str | Path, fps: float | None = None) -> JointClip:
    """Read a table in any of the three forms.

    Args:
        path: of the file.
        fps: frames per second of a file that has no rate; by default the rate of its form.

    Raises:
        MotionFileError: columns that are missing, double, or in an unknown unit; rows of another
            length or with something else than finite numbers; unequal time steps.
    """
    with reading(path, "table of a robot's joint angles"):
        lines, file_fps = read_lines(Path(path))
        width = len(lines[0])
        if width == 1:
            raise MotionFileError(
                f"{path}: has one column, expected several with commas between them; the first "
                f"line begins with '{lines[0][0][:40]}'"
            )
        if width > MAX_COLUMNS or max(map(len, lines[0])) > MAX_COLUMN_LENGTH:
            raise MotionFileError(
                f"{path}: the first line has {width} columns of up to {max(map(len, lines[0]))} "
                f"characters, expected at most {MAX_COLUMNS} and {MAX_COLUMN_LENGTH}"
            )
        if is_number(lines[0][0]):
            table = read_numbers(lines, width, path)
            return _headerless(table, file_fps or fps or LAFAN1_FPS, path)
        names, units = _header(lines[0], path)
        table = read_numbers(lines[1:], width, path)
        if _BONES_POSITION[0] in names:
            return _bones(names, table, file_fps or fps or BONES_FPS, path)
        return _own(names, units, table, file_fps or fps, path)


def is_number(text: str) -> bool:
    """Return whether a cell is a number rather than a name of a column."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _headerless(table: FloatArray, fps: float, path: str | Path) -> JointClip:
    num_dofs = table.shape[1] - _ROOT_WIDTH
    if num_dofs < 1:
        raise MotionFileError(
            f"{path}: has {table.shape[1]} columns and no header, expected root position (3), "
            "root quaternion (4) and at least one joint"
        )
    position, rotation, dof_pos = np.split(table, (3, _ROOT_WIDTH), axis=1)
    return JointClip(str(path), fps, position, rotation, dof_pos, BY_NUMBER.get(num_dofs))


def _header(cells: list[str], path: str | Path) -> tuple[list[str], list[str | None]]:
    header = [match for text in cells if (match := COLUMN.fullmatch(text))]
    if len(header) != len(cells):
        raise MotionFileError(f"{path}: the header has a column that is not like 'name [unit]'")
    names = [match["name"] for match in header]
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise MotionFileError(f"{path}: the header names {', '.join(double)} twice")
    return names, [match["unit"] for match in header]


def _require(names: list[str], needed: tuple[str, ...], path: str | Path) -> None:
    missing = [name for name in needed if name not in names]
    if missing:
        raise MotionFileError(
            f"{path}: the header lacks {', '.join(missing)}; docs/motion_formats.md has the "
            "columns of robots' clips"
        )


def _bones(names: list[str], table: FloatArray, fps: float, path: str | Path) -> JointClip:
    _require(names, (*_BONES_POSITION, *_BONES_ROTATION), path)
    column = {name: table[:, i] for i, name in enumerate(names)}
    if _BONES_FRAME in column and not np.all(np.diff(column[_BONES_FRAME]) == 1.0):
        raise MotionFileError(f"{path}: frames are missing, '{_BONES_FRAME}' is not 0, 1, 2, ...")
    root = {_BONES_FRAME, *_BONES_POSITION, *_BONES_ROTATION}
    joints = [name for name in names if name not in root]
    if not joints:
        raise MotionFileError(f"{path}: the header names no joints behind the root's columns")
    angles = (torch.from_numpy(np.deg2rad(column[name])) for name in _BONES_ROTATION)
    return JointClip(
        str(path),
        fps,
        np.stack([column[name] for name in _BONES_POSITION], axis=-1) * LENGTH_UNITS["cm"],
        rotations.quat_from_euler_xyz(*angles).numpy(),
        np.deg2rad(np.stack([column[name] for name in joints], axis=-1)),
        tuple(name.removesuffix("_dof") for name in joints),
        file_quat_order=None,
    )


def _own(
    names: list[str],
    units: list[str | None],
    table: FloatArray,
    fps: float | None,
    path: str | Path,
) -> JointClip:
    _require(names, (*POSITION, *ROTATION), path)
    column = {}
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        choices = _units_of(name)
        if choices and unit not in choices:
            raise MotionFileError(
                f"{path}: the column '{name}' has {f'the unit {unit!r}' if unit else 'no unit'}; "
                f"choices: {', '.join(choices)}"
            )
        column[name] = table[:, i] * (choices[unit] if choices and unit else 1.0)
    if TIME in column:
        fps = frame_rate(column[TIME], path)
    if fps is None:
        raise MotionFileError(
            f"{path}: has no column 'time [s]'; add one, or the first line '# fps: 30'"
        )
    joints = [name for name in names if name not in (TIME, *POSITION, *ROTATION)]
    if not joints:
        raise MotionFileError(f"{path}: the header names no joints behind the root's columns")
    position, rotation, dof_pos = (
        np.stack([column[name] for name in part], axis=-1) for part in (POSITION, ROTATION, joints)
    )
    return JointClip(str(path), fps, position, rotation, dof_pos, tuple(joints))


def _units_of(name: str) -> dict[str, float]:
    if name == TIME:
        return TIME_UNITS
    if name in POSITION:
        return LENGTH_UNITS
    return {} if name in ROTATION else ANGLE_UNITS


def save_robot_csv(path: str | Path, clip: JointClip, header: bool = True) -> Path:
    """Write a clip as a table; returns the path.

    Args:
        path: of the file.
        clip: with names of its joints if a header is written.
        header: this project's form, which has names, units and times; False: Unitree's LAFAN1
            form, which has neither and is read at 30 fps.

    Raises:
        MotionFileError: the clip is not valid or lacks names, or the file cannot be written.
    """
    clip.validate()
    path = Path(path)
    table = np.concatenate((clip.root_pos, clip.root_rot, clip.dof_pos), axis=1, dtype=np.float64)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if header:
        if clip.joint_names is None:
            raise MotionFileError(f"{clip.name}: has no names of joints; write it without a header")
        table = np.concatenate((np.arange(clip.num_frames)[:, None] / clip.fps, table), axis=1)
        names = (TIME, *POSITION, *ROTATION, *clip.joint_names)
        units = [next(iter(_units_of(name)), None) for name in names]
        writer.writerow(f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True))
    writer.writerows([f"{value:.12g}" for value in row] for row in table.tolist())
    with written_clip(path) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8")
    return path
