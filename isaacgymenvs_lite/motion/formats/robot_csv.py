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

from pathlib import Path

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.formats.joint_csv import (
    LENGTH_UNITS,
    POSITION,
    ROTATION,
    TIME,
    check_columns,
    frame_rate,
    is_number,
    joined,
    read_columns,
    read_header,
    read_lines,
    read_numbers,
    write_table,
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
        lines, file_fps = read_lines(path)
        fps = file_fps or fps
        if len(lines[0]) == 1:
            raise MotionFileError(
                f"{path}: has one column, expected several with commas between them; the first "
                f"line begins with '{lines[0][0][:40]}'"
            )
        if is_number(lines[0][0]):
            table = read_numbers(lines, len(lines[0]), path)
            if table.shape[1] <= _ROOT_WIDTH:
                raise MotionFileError(
                    f"{path}: has {table.shape[1]} columns and no header, expected root position "
                    "(3), root quaternion (4) and at least one joint"
                )
            position, rotation, dof_pos = np.split(table, (3, _ROOT_WIDTH), axis=1)
            names = BY_NUMBER.get(dof_pos.shape[1])
            return JointClip(str(path), fps or LAFAN1_FPS, position, rotation, dof_pos, names)
        names, units = read_header(lines[0], path)
        if _BONES_POSITION[0] in names:
            table = read_numbers(lines[1:], len(names), path)
            return _bones(names, table, fps or BONES_FPS, path)
        joints = _joints(names, (TIME, *POSITION, *ROTATION), path)
        column = read_columns(names, units, lines[1:], path)
        return JointClip(
            str(path),
            frame_rate(column, fps, path),
            joined(column, POSITION),
            joined(column, ROTATION),
            joined(column, joints),
            tuple(joints),
        )


def _joints(names: list[str], others: tuple[str, ...], path: str | Path) -> list[str]:
    """Return the names that are not `others`, of which all but the first must be there, too."""
    check_columns(names, others[1:], path)
    joints = [name for name in names if name not in others]
    if not joints:
        raise MotionFileError(f"{path}: the header names no joint columns after the root columns")
    return joints


def _bones(names: list[str], table: FloatArray, fps: float, path: str | Path) -> JointClip:
    joints = _joints(names, (_BONES_FRAME, *_BONES_POSITION, *_BONES_ROTATION), path)
    column = {name: table[:, i] for i, name in enumerate(names)}
    if _BONES_FRAME in column and not np.all(np.diff(column[_BONES_FRAME]) == 1.0):
        raise MotionFileError(f"{path}: frames are missing, '{_BONES_FRAME}' is not 0, 1, 2, ...")
    angles = (torch.from_numpy(np.deg2rad(column[name])) for name in _BONES_ROTATION)
    return JointClip(
        str(path),
        fps,
        joined(column, _BONES_POSITION) * LENGTH_UNITS["cm"],
        rotations.quat_from_euler_xyz(*angles).numpy(),
        np.deg2rad(joined(column, joints)),
        tuple(name.removesuffix("_dof") for name in joints),
        file_quat_order=None,
    )


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
    if header and clip.joint_names is None:
        raise MotionFileError(f"{clip.name}: has no names of joints; write it without a header")
    table = np.concatenate((clip.root_pos, clip.root_rot, clip.dof_pos), axis=1, dtype=np.float64)
    return write_table(path, table, clip.joint_names if header else None, clip.fps)
