"""Reads and writes clips as tables of joint angles (`.csv`), for the humanoids and for robots.

In this project's tables, the header has the name and unit of each column: `time [s]`, `root_x [m]`,
..., `root_qx`, ..., and then every degree of freedom, for example `abdomen_x [rad]`
(docs/motion_formats.md). Tables of robots in two other forms are read:

- A table without a header holds root position (m), root quaternion xyzw and joint angles (rad) at
  30 fps. Source: Unitree's retargeted LAFAN1 (README of
  unitreerobotics/LAFAN1_Retargeting_Dataset). Kimodo's tables have quaternions wxyz.
- A table of BONES-SEED has the columns `Frame`, `root_translateX`, ... (cm), `root_rotateX`, ...
  (degrees, rotations about the fixed axes x, y, z in this order), and `left_hip_pitch_joint_dof`,
  ... (degrees), at 120 fps. Source: NVlabs/ProtoMotions, data/scripts/convert_g1_csv_to_proto.py;
  this reader was not tested with the original data.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError, unknown
from isaacgymenvs_lite.motion.clip import MAX_JOINT_RAD, JointClip, MotionClip
from isaacgymenvs_lite.motion.formats.files import reading, written_clip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import dofs_of_clip, rotations_from_dofs
from isaacgymenvs_lite.motion.skeleton import SHIPPED_NUM_DOFS, Skeleton, skeleton_for_num_dofs
from isaacgymenvs_lite.utils import rotations

_TIME = "time"
_POSITION = ("root_x", "root_y", "root_z")
_ROTATION = ("root_qx", "root_qy", "root_qz", "root_qw")
_OWN = (_TIME, *_POSITION, *_ROTATION)
# Factors that convert units to s, m and rad; files are written with the first unit of each kind.
_TIME_UNITS = {"s": 1.0, "ms": 1e-3}
_LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180.0}
_COLUMN = re.compile(r"\s*(?P<name>[^\[\]]*?)\s*(\[\s*(?P<unit>[^\[\]]*?)\s*\])?\s*")
_FPS_LINE = re.compile(r"#\s*fps\s*[:=]\s*(?P<fps>\S+)\s*", re.IGNORECASE)
# Relative tolerance of a time step; times are often rounded to milliseconds.
_STEP_TOLERANCE = 0.1
_LAFAN1_FPS, _BONES_FPS = 30.0, 120.0
_ROOT_WIDTH = 7
_BONES_FRAME = "Frame"
_BONES_POSITION = tuple(f"root_translate{axis}" for axis in "XYZ")
_BONES_ROTATION = tuple(f"root_rotate{axis}" for axis in "XYZ")
_ARM_7 = (
    *("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),
    *("wrist_roll", "wrist_pitch", "wrist_yaw"),
)


def _sides(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{side}_{joint}_joint" for side in ("left", "right") for joint in joints)


# Joint orders in the README of Unitree's LAFAN1 data and in the robots' model files.
G1_29 = (
    *_sides(("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")),
    *("waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint"),
    *_sides(_ARM_7),
)
_H1_2_27 = (
    *_sides(("hip_yaw", "hip_pitch", "hip_roll", "knee", "ankle_pitch", "ankle_roll")),
    "torso_joint",
    *_sides(_ARM_7),
)
_H1_19 = (
    *_sides(("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")),
    "torso_joint",
    *_sides(_ARM_7[:4]),
)
# Maps the number of joints in a table without a header to the robot's joint names.
_BY_NUMBER = {len(names): names for names in (G1_29, _H1_2_27, _H1_19)}
_ARMS_START = ("",) * 3  # The arms' first joints are in the fourth level below the root.
_LEVELS = itertools.zip_longest(
    *(G1_29[:6], G1_29[6:12], G1_29[12:15]),
    *(_ARMS_START + G1_29[15:22], _ARMS_START + G1_29[22:]),
    fillvalue="",
)
G1_29_BREADTH_FIRST = tuple(joint for level in _LEVELS for joint in level if joint)
"""The joints of G1 in Isaac Lab's order, which is breadth-first."""


def save_joint_csv(path: str | Path, clip: MotionClip, skeleton: Skeleton) -> Path:
    """Write a clip with the bodies of `skeleton`, and return the path.

    The file does not contain velocities, limb lengths, and rotations that leave a hinge's axis.
    """
    clip.validate()
    root = (clip.root_translation, clip.local_rotation[:, 0])
    table = np.concatenate((*root, dofs_of_clip(skeleton, clip)), axis=1)
    return _write_table(path, table, skeleton.dof_names, clip.fps)


def save_robot_csv(path: str | Path, clip: JointClip) -> Path:
    """Write a clip of a robot, and return the path; the clip must have joint names."""
    clip.validate()
    table = np.concatenate((clip.root_pos, clip.root_rot, clip.dof_pos), axis=1, dtype=np.float64)
    return _write_table(path, table, clip.joint_names or (), clip.fps)


def load_joint_csv(path: str | Path, skeletons: Sequence[Skeleton]) -> MotionClip:
    """Read a clip of a humanoid; the DOFs in the header determine the skeleton.

    Columns may be in any order; angles may be in rad or deg, and lengths in m, cm or mm. A file
    without the column `time` needs a line like `# fps: 30`.
    """
    with reading(path, "table of joint angles"):
        lines, fps = _read_lines(path)
        names, units = _read_header(lines[0], path)
        # The humanoid with most of the named DOFs is chosen. If several humanoids have the same
        # number, the humanoid with the fewest other DOFs is chosen.
        skeleton = max(
            skeletons, key=lambda body: (len(set(body.dof_names) & set(names)), -body.num_dofs)
        )
        known = (*_OWN, *skeleton.dof_names)
        others = [name for name in names if name not in known]
        if others:
            raise MotionFileError(f"{path}: {unknown('column', others[0], known)}")
        _check_columns(names, known[1:], path)
        column = _read_columns(names, units, lines[1:], path)
        dofs = _joined(column, skeleton.dof_names)
        if np.abs(dofs).max() > MAX_JOINT_RAD:
            raise MotionFileError(
                f"{path}: a joint angle is {np.abs(dofs).max():.3g} rad, expected at most "
                f"{MAX_JOINT_RAD:g}"
            )
        return MotionClip.from_poses(
            str(path),
            _frame_rate(column, fps, path),
            skeleton.body_names,
            skeleton.parent_indices,
            skeleton.local_translation,
            rotations_from_dofs(skeleton, _joined(column, _ROTATION), dofs),
            _joined(column, _POSITION),
        )


def is_robot_csv(path: str | Path) -> bool:
    """Return whether a table has no header, or mostly joints that shipped humanoids do not have."""
    header = _read_lines(path)[0][0]
    if _is_number(header[0]):
        return True
    joints = set(_read_header(header, path)[0]) - set(_OWN)
    of_humanoids = {
        name for number in SHIPPED_NUM_DOFS for name in skeleton_for_num_dofs(number).dof_names
    }
    return len(joints & of_humanoids) < len(joints) / 2


def load_robot_csv(path: str | Path, fps: float | None = None) -> JointClip:
    """Read a table of a robot's joint angles in one of the three forms of the module docstring.

    `fps` is the frame rate of a file that contains no rate; None selects the form's default rate.
    """
    lines, file_fps = _read_lines(path)
    fps = file_fps or fps
    if len(lines[0]) == 1:
        raise MotionFileError(
            f"{path}: has one column, expected several with commas between them; the first "
            f"line begins with '{lines[0][0][:40]}'"
        )
    if _is_number(lines[0][0]):
        table = _read_numbers(lines, len(lines[0]), path)
        if table.shape[1] <= _ROOT_WIDTH:
            raise MotionFileError(
                f"{path}: has {table.shape[1]} columns and no header, expected root position "
                "(3), root quaternion (4) and at least one joint"
            )
        position, rotation, dof_pos = np.split(table, (3, _ROOT_WIDTH), axis=1)
        names = _BY_NUMBER.get(dof_pos.shape[1])
        return JointClip(str(path), fps or _LAFAN1_FPS, position, rotation, dof_pos, names)
    names, units = _read_header(lines[0], path)
    is_bones = _BONES_POSITION[0] in names
    others = (_BONES_FRAME, *_BONES_POSITION, *_BONES_ROTATION) if is_bones else _OWN
    _check_columns(names, others[1:], path)
    joints = [name for name in names if name not in others]
    if not joints:
        raise MotionFileError(f"{path}: the header names no joint columns after the root columns")
    if not is_bones:
        column = _read_columns(names, units, lines[1:], path)
        rate = _frame_rate(column, fps, path)
        position, rotation = _joined(column, _POSITION), _joined(column, _ROTATION)
        dof_pos = _joined(column, joints)
        return JointClip(str(path), rate, position, rotation, dof_pos, tuple(joints))
    table = _read_numbers(lines[1:], len(names), path)
    column = {name: table[:, i] for i, name in enumerate(names)}
    if _BONES_FRAME in column and not np.all(np.diff(column[_BONES_FRAME]) == 1.0):
        raise MotionFileError(f"{path}: frames are missing, '{_BONES_FRAME}' is not 0, 1, 2, ...")
    angles = (torch.from_numpy(np.deg2rad(column[name])) for name in _BONES_ROTATION)
    return JointClip(
        str(path),
        fps or _BONES_FPS,
        _joined(column, _BONES_POSITION) * _LENGTH_UNITS["cm"],
        rotations.quat_from_euler_xyz(*angles).numpy(),
        np.deg2rad(_joined(column, joints)),
        tuple(name.removesuffix("_dof") for name in joints),
        file_quat_order=None,
    )


def _read_lines(path: str | Path) -> tuple[list[list[str]], float | None]:
    """Return the cells of all lines, and the frame rate in the line `# fps:`."""
    lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    comments = [line for line in lines if line.startswith("#")]
    rows = list(csv.reader(line for line in lines if line.strip() and not line.startswith("#")))
    if len(rows) < 2:
        raise MotionFileError(
            f"{path}: holds {len(rows)} line(s), expected a header and rows of numbers"
        )
    rates = [match["fps"] for line in comments if (match := _FPS_LINE.fullmatch(line))]
    return rows, float(rates[0]) if rates else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_header(cells: list[str], path: str | Path) -> tuple[list[str], list[str | None]]:
    """Return names and units of the columns."""
    header = [match for text in cells if (match := _COLUMN.fullmatch(text))]
    if len(header) != len(cells):
        raise MotionFileError(f"{path}: the header has a column that is not 'name [unit]'")
    names = [match["name"] for match in header]
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise MotionFileError(f"{path}: the header names {', '.join(double)} twice")
    return names, [match["unit"] for match in header]


def _check_columns(names: list[str], needed: Iterable[str], path: str | Path) -> None:
    missing = [name for name in needed if name not in names]
    if missing:
        raise MotionFileError(
            f"{path}: the header lacks {', '.join(missing)}; docs/motion_formats.md has the columns"
            " of clips"
        )


def _read_columns(
    names: list[str], units: list[str | None], rows: list[list[str]], path: str | Path
) -> dict[str, FloatArray]:
    """Return a dictionary from names to columns (T,), which are converted to s, m and rad."""
    table = _read_numbers(rows, len(names), path)
    column = {}
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        choices = _units_of(name)
        if choices and unit not in choices:
            given = "no unit" if unit is None else f"the unit '{unit}'"
            raise MotionFileError(
                f"{path}: the column '{name}' has {given}; choices: "
                + ", ".join(f"'{name} [{choice}]'" for choice in choices)
            )
        column[name] = table[:, i] * (choices[unit] if choices and unit else 1.0)
    return column


def _joined(column: Mapping[str, FloatArray], names: Iterable[str]) -> FloatArray:
    return np.stack([column[name] for name in names], axis=-1)


def _units_of(name: str) -> dict[str, float]:
    if name == _TIME:
        return _TIME_UNITS
    if name in _POSITION:
        return _LENGTH_UNITS
    return {} if name in _ROTATION else _ANGLE_UNITS


def _read_numbers(rows: list[list[str]], width: int, path: str | Path) -> FloatArray:
    """Return the values (T, width) of all rows; raise an error if a value is not finite."""
    for i, row in enumerate(rows):
        if len(row) != width:
            raise MotionFileError(
                f"{path}: row {i + 1} has {len(row)} values, expected {width} as in the first line"
            )
    table = np.array(rows, dtype=np.float64)
    if not np.isfinite(table).all():
        row = int((~np.isfinite(table)).any(axis=1).argmax())
        raise MotionFileError(f"{path}: row {row + 1} holds NaN or infinity")
    return table


def _frame_rate(column: Mapping[str, FloatArray], fps: float | None, path: str | Path) -> float:
    """Return the frames per second from the column `time`, or `fps` if there is no such column."""
    if _TIME not in column:
        if fps is None:
            raise MotionFileError(
                f"{path}: has no column 'time [s]'; add one, or the first line '# fps: 30'"
            )
        return fps
    steps = np.diff(column[_TIME])
    if len(steps) == 0:
        raise MotionFileError(f"{path}: holds 1 frame, expected at least 2")
    mean = float(steps.mean())
    if mean <= 0.0 or np.abs(steps - mean).max() > _STEP_TOLERANCE * mean:
        raise MotionFileError(
            f"{path}: the time steps are {steps.min():g} to {steps.max():g} s, expected equal steps"
            " above 0"
        )
    return 1.0 / mean


def _write_table(
    path: str | Path, table: FloatArray, joint_names: Sequence[str], fps: float
) -> Path:
    """Write times and a table (T, 7 + D) of root position (m), quaternion xyzw, joints (rad)."""
    table = np.concatenate((np.arange(len(table))[:, None] / fps, table), axis=1)
    names = (*_OWN, *joint_names)
    units = [next(iter(_units_of(name)), None) for name in names]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True))
    writer.writerows([f"{value:.12g}" for value in row] for row in table.tolist())
    path = Path(path)
    with written_clip(path) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8")
    return path
