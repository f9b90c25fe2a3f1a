"""Clips of the humanoids as tables of joint angles (`.csv`), for spreadsheets, pandas and others.

The header names each column and its unit: `time [s]`, `root_x [m]`, ..., `root_qx`, ..., then
every degree of freedom of the humanoid, such as `abdomen_x [rad]`. docs/motion_formats.md
describes them. `formats.robot_csv` has the tables of robots, and shares the functions below.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from isaacgymenvs_lite.errors import MotionFileError, unknown
from isaacgymenvs_lite.motion.clip import MAX_JOINT_RAD, MotionClip
from isaacgymenvs_lite.motion.formats.files import reading, written_clip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import dofs_of_clip, rotations_from_dofs
from isaacgymenvs_lite.motion.skeleton import Skeleton

TIME = "time"
POSITION = ("root_x", "root_y", "root_z")
ROTATION = ("root_qx", "root_qy", "root_qz", "root_qw")
# Factors to the unit of the clip; the first of each kind is the one that is written.
_TIME_UNITS = {"s": 1.0, "ms": 1e-3}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180.0}
_COLUMN = re.compile(r"\s*(?P<name>[^\[\]]*?)\s*(\[\s*(?P<unit>[^\[\]]*?)\s*\])?\s*")
_FPS_LINE = re.compile(r"#\s*fps\s*[:=]\s*(?P<fps>\S+)\s*", re.IGNORECASE)
# How much a time step may differ from the others; times are often rounded to milliseconds.
_STEP_TOLERANCE = 0.1


def save_joint_csv(path: str | Path, clip: MotionClip, skeleton: Skeleton) -> Path:
    """Write a clip whose bodies are in the order of `skeleton`; returns the path.

    The format has no velocities, limb lengths and rotations of hinges out of their axes.

    Raises:
        MotionFileError: the clip is not valid, or the file cannot be written.
    """
    clip.validate()
    root = (clip.root_translation, clip.local_rotation[:, 0])
    table = np.concatenate((*root, dofs_of_clip(skeleton, clip)), axis=1)
    return write_table(path, table, skeleton.dof_names, clip.fps)


def load_joint_csv(path: str | Path, skeletons: Sequence[Skeleton]) -> MotionClip:
    """Read a clip; the columns may be in any order, angles in rad or deg, lengths in m, cm, mm.

    Args:
        path: of the file. Without a column `time` its first line is `# fps: 30`.
        skeletons: the humanoids that it may belong to; the DOFs in the header determine which.

    Raises:
        MotionFileError: no header, columns that are missing, unknown, double or in an unknown unit;
            rows of another length or with something else than finite numbers; unequal time steps.
    """
    with reading(path, "table of joint angles"):
        lines, fps = read_lines(path)
        names, units = read_header(lines[0], path)
        # The humanoid with most of the named DOFs; of equal ones the one with fewest others.
        skeleton = max(
            skeletons,
            key=lambda body: (len(set(body.dof_names) & set(names)), -body.num_dofs),
        )
        known = (TIME, *POSITION, *ROTATION, *skeleton.dof_names)
        others = [name for name in names if name not in known]
        if others:
            raise MotionFileError(f"{path}: {unknown('column', others[0], known)}")
        check_columns(names, known[1:], path)
        column = read_columns(names, units, lines[1:], path)
        dofs = joined(column, skeleton.dof_names)
        if np.abs(dofs).max() > MAX_JOINT_RAD:
            raise MotionFileError(
                f"{path}: a joint angle is {np.abs(dofs).max():.3g} rad, expected at most "
                f"{MAX_JOINT_RAD:g}"
            )
        return MotionClip.from_poses(
            str(path),
            frame_rate(column, fps, path),
            skeleton.body_names,
            skeleton.parent_indices,
            skeleton.local_translation,
            rotations_from_dofs(skeleton, joined(column, ROTATION), dofs),
            joined(column, POSITION),
        )


# --- tables of joint angles, of humanoids and of robots -------------------------------------------


def read_lines(path: str | Path) -> tuple[list[list[str]], float | None]:
    """Return the cells of the header and of the rows, and the rate of the line `# fps:`."""
    lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    comments = [line for line in lines if line.startswith("#")]
    rows = list(csv.reader(line for line in lines if line.strip() and not line.startswith("#")))
    if len(rows) < 2:
        raise MotionFileError(
            f"{path}: holds {len(rows)} line(s), expected a header and rows of numbers"
        )
    rates = [match["fps"] for line in comments if (match := _FPS_LINE.fullmatch(line))]
    if rates and not is_number(rates[0]):
        raise MotionFileError(f"{path}: fps is {rates[0]!r}, expected a number")
    return rows, float(rates[0]) if rates else None


def is_number(text: str) -> bool:
    """Return whether a cell is a number rather than a name of a column."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def read_header(cells: list[str], path: str | Path) -> tuple[list[str], list[str | None]]:
    """Return the names of the columns, and their units."""
    header = [match for text in cells if (match := _COLUMN.fullmatch(text))]
    if len(header) != len(cells):
        raise MotionFileError(f"{path}: the header has a column that is not like 'name [unit]'")
    names = [match["name"] for match in header]
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise MotionFileError(f"{path}: the header names {', '.join(double)} twice")
    return names, [match["unit"] for match in header]


def check_columns(names: list[str], needed: Iterable[str], path: str | Path) -> None:
    """Raise a MotionFileError for a header that lacks columns."""
    missing = [name for name in needed if name not in names]
    if missing:
        raise MotionFileError(
            f"{path}: the header lacks {', '.join(missing)}; docs/motion_formats.md has the columns"
            " of clips"
        )


def read_columns(
    names: list[str], units: list[str | None], rows: list[list[str]], path: str | Path
) -> dict[str, FloatArray]:
    """Return the columns (T) by their names, in s, m and rad."""
    table = read_numbers(rows, len(names), path)
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


def joined(column: Mapping[str, FloatArray], names: Iterable[str]) -> FloatArray:
    """Return the named columns (T) as one array (T, number of names)."""
    return np.stack([column[name] for name in names], axis=-1)


def _units_of(name: str) -> dict[str, float]:
    if name == TIME:
        return _TIME_UNITS
    if name in POSITION:
        return LENGTH_UNITS
    return {} if name in ROTATION else _ANGLE_UNITS


def read_numbers(rows: list[list[str]], width: int, path: str | Path) -> FloatArray:
    """Return the rows (T, width) as numbers."""
    for i, row in enumerate(rows):
        if len(row) != width:
            raise MotionFileError(
                f"{path}: row {i + 1} has {len(row)} values, expected {width} as in the first line"
            )
    table = np.array(rows, dtype=np.float64)
    if not np.isfinite(table).all():
        row = int((~np.isfinite(table)).any(axis=1).argmax())
        raise MotionFileError(f"{path}: row {row + 1} holds a number that is NaN or infinite")
    return table


def frame_rate(column: Mapping[str, FloatArray], fps: float | None, path: str | Path) -> float:
    """Return the frames per second that the column `time` shows; without it, `fps`.

    Raises:
        MotionFileError: there is neither, or the time steps are unequal.
    """
    if TIME not in column:
        if fps is None:
            raise MotionFileError(
                f"{path}: has no column 'time [s]'; add one, or the first line '# fps: 30'"
            )
        return fps
    steps = np.diff(column[TIME])
    if len(steps) == 0:
        raise MotionFileError(f"{path}: holds 1 frame, expected at least 2")
    mean = float(steps.mean())
    if mean <= 0.0 or np.abs(steps - mean).max() > _STEP_TOLERANCE * mean:
        raise MotionFileError(
            f"{path}: the time steps are {steps.min():g} to {steps.max():g} s, expected equal ones "
            "above 0"
        )
    return 1.0 / mean


def write_table(
    path: str | Path, table: FloatArray, joint_names: Sequence[str] | None, fps: float
) -> Path:
    """Write the root's position and rotation and the joints (T, 7 + D) m, rad; returns the path.

    D names make a header with units and a column of times at `fps`; None: neither.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if joint_names is not None:
        table = np.concatenate((np.arange(len(table))[:, None] / fps, table), axis=1)
        names = (TIME, *POSITION, *ROTATION, *joint_names)
        units = [next(iter(_units_of(name)), None) for name in names]
        writer.writerow(f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True))
    writer.writerows([f"{value:.12g}" for value in row] for row in table.tolist())
    path = Path(path)
    with written_clip(path) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8")
    return path
