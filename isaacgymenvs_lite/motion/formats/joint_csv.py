"""Clips of the humanoids as tables of joint angles (`.csv`), for spreadsheets, pandas and others.

The header names each column and its unit: `time [s]`, `root_x [m]`, ..., `root_qx`, ..., then
every degree of freedom of the humanoid, such as `abdomen_x [rad]`. docs/motion_formats.md
describes them. `formats.robot_csv` has the tables of robots.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from isaacgymenvs_lite.errors import MotionFileError, one_line, suggest
from isaacgymenvs_lite.motion.clip import MAX_JOINT_RAD, MotionClip
from isaacgymenvs_lite.motion.formats.files import (
    MAX_TEXT_BYTES,
    read_bytes,
    reading,
    written_clip,
)
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import dofs_of_clip, rotations_from_dofs
from isaacgymenvs_lite.motion.skeleton import Skeleton

TIME = "time"
POSITION = ("root_x", "root_y", "root_z")
ROTATION = ("root_qx", "root_qy", "root_qz", "root_qw")
# Factors to the unit of the clip; the first of each kind is the one that is written.
TIME_UNITS = {"s": 1.0, "ms": 1e-3}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180.0}
COLUMN = re.compile(r"\s*(?P<name>[^\[\]]*?)\s*(\[\s*(?P<unit>[^\[\]]*?)\s*\])?\s*")
_FPS_LINE = re.compile(r"#\s*fps\s*[:=]\s*(?P<fps>\S+)\s*", re.IGNORECASE)
# How much a time step may differ from the others; times are often rounded to milliseconds.
_STEP_TOLERANCE = 0.1
# The humanoid with sword and shield has 39 columns.
MAX_COLUMNS, MAX_COLUMN_LENGTH = 200, 200
# A cell takes 60 bytes until it is a number.
_MAX_LINES, _MAX_CELLS = 200_000, 3_000_000


def save_joint_csv(path: str | Path, clip: MotionClip, skeleton: Skeleton) -> Path:
    """Write a clip whose bodies are in the order of `skeleton`; returns the path.

    The format has no velocities, limb lengths and rotations of hinges out of their axes.

    Raises:
        MotionFileError: the clip is not valid, or the file cannot be written.
    """
    clip.validate()
    path = Path(path)
    table = np.concatenate(
        (
            np.arange(clip.num_frames)[:, None] / clip.fps,
            clip.root_translation,
            clip.local_rotation[:, 0],
            dofs_of_clip(skeleton, clip),
        ),
        axis=1,
    )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        f"{name} [{next(iter(units))}]" if units else name
        for name, units in _columns(skeleton).items()
    )
    writer.writerows([f"{value:.12g}" for value in row] for row in table.tolist())
    with written_clip(path) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8")
    return path


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
        return _clip(path, skeletons)


def _clip(path: str | Path, skeletons: Sequence[Skeleton]) -> MotionClip:
    lines, fps = read_lines(Path(path))
    if len(lines[0]) > MAX_COLUMNS or max(map(len, lines[0])) > MAX_COLUMN_LENGTH:
        raise MotionFileError(
            f"{path}: the header has {len(lines[0])} columns with names of up to "
            f"{max(map(len, lines[0]))} characters, expected at most {MAX_COLUMNS} and "
            f"{MAX_COLUMN_LENGTH}"
        )
    header = [COLUMN.fullmatch(text) for text in lines[0]]
    if not all(header):
        raise MotionFileError(f"{path}: the header has a column that is not like 'name [unit]'")
    names = [match["name"] for match in header if match]
    skeleton = _skeleton_of(names, skeletons)
    factors = _factors(names, [match["unit"] for match in header if match], skeleton, path)
    table = read_numbers(lines[1:], len(names), path) * factors
    column = {name: table[:, i] for i, name in enumerate(names)}
    if TIME in column:
        fps = frame_rate(column[TIME], path)
    if fps is None:
        raise MotionFileError(
            f"{path}: has no column 'time [s]'; add one, or the first line '# fps: 30'"
        )
    root_rotation = np.stack([column[name] for name in ROTATION], axis=-1)
    dofs = np.stack([column[name] for name in skeleton.dof_names], axis=-1)
    if np.abs(dofs).max() > MAX_JOINT_RAD:
        raise MotionFileError(
            f"{path}: a joint angle is {np.abs(dofs).max():.3g} rad, expected at most "
            f"{MAX_JOINT_RAD:g}"
        )
    root = np.stack([column[name] for name in POSITION], axis=-1)
    return MotionClip.from_poses(
        str(path),
        fps,
        skeleton.body_names,
        skeleton.parent_indices,
        skeleton.local_translation,
        rotations_from_dofs(skeleton, root_rotation, dofs),
        root,
    )


def _columns(skeleton: Skeleton) -> dict[str, dict[str, float]]:
    """Return the names of all columns and the units each may have; none for quaternions."""
    return {
        TIME: TIME_UNITS,
        **dict.fromkeys(POSITION, LENGTH_UNITS),
        **{name: {} for name in ROTATION},
        **dict.fromkeys(skeleton.dof_names, ANGLE_UNITS),
    }


def read_lines(path: Path) -> tuple[list[list[str]], float | None]:
    """Return the cells of the header and of the rows, and the rate of the line `# fps:`."""
    comments, kept = [], []
    try:
        text = read_bytes(path, MAX_TEXT_BYTES).decode("utf-8-sig")
        if text.count(",") > _MAX_CELLS:
            raise MotionFileError(
                f"{path}: has more than {_MAX_CELLS:,} values; cut it into several clips"
            )
        for number, line in enumerate(io.StringIO(text, newline=None)):
            if number > _MAX_LINES:
                raise MotionFileError(
                    f"{path}: has more than {_MAX_LINES:,} lines; cut it into several clips"
                )
            if line.startswith("#"):
                comments.append(line[:MAX_COLUMN_LENGTH].rstrip("\n"))
            elif line.strip():
                kept.append(line)
        lines = list(csv.reader(kept))
    except (UnicodeDecodeError, csv.Error) as error:
        raise MotionFileError(f"{path}: is no CSV text ({one_line(error)})") from error
    if len(lines) < 2:
        raise MotionFileError(
            f"{path}: holds {len(lines)} line(s), expected a header and rows of numbers"
        )
    rates = [match["fps"] for line in comments if (match := _FPS_LINE.fullmatch(line))]
    try:
        return lines, float(rates[0]) if rates else None
    except ValueError as error:
        raise MotionFileError(f"{path}: fps is {rates[0]!r}, expected a number") from error


def _skeleton_of(names: list[str], skeletons: Sequence[Skeleton]) -> Skeleton:
    """Return the humanoid with most of the named DOFs; of equal ones the one with fewest others."""
    return max(
        skeletons,
        key=lambda body: (len(set(body.dof_names) & set(names)), -body.num_dofs),
    )


def _factors(
    names: list[str], units: list[str | None], skeleton: Skeleton, path: str | Path
) -> FloatArray:
    """Check the header and return the factor of each column."""
    known = _columns(skeleton)
    for name in names:
        if name not in known:
            raise MotionFileError(
                f"{path}: unknown column '{name}'{suggest(name, known)}; "
                f"choices: {', '.join(known)}"
            )
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise MotionFileError(f"{path}: the header names {', '.join(double)} twice")
    missing = [name for name in known if name not in names and name != TIME]
    if missing:
        raise MotionFileError(
            f"{path}: the header lacks {', '.join(missing)}; a clip of the humanoid with "
            f"{skeleton.num_dofs} degrees of freedom names the root and all of them"
        )
    factors = []
    for name, unit in zip(names, units, strict=True):
        choices = known[name]
        if choices and unit not in choices:
            given = "no unit" if unit is None else f"the unit '{unit}'"
            raise MotionFileError(
                f"{path}: the column '{name}' has {given}; choices: "
                + ", ".join(f"'{name} [{choice}]'" for choice in choices)
            )
        factors.append(choices[unit] if choices and unit else 1.0)
    return np.array(factors)


def read_numbers(rows: list[list[str]], width: int, path: str | Path) -> FloatArray:
    """Return the rows (T, width) as numbers."""
    for i, row in enumerate(rows):
        if len(row) != width:
            raise MotionFileError(
                f"{path}: row {i + 1} has {len(row)} values, expected {width} as in the first line"
            )
    try:
        table = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise MotionFileError(f"{path}: a value is no number ({one_line(error)})") from error
    if not np.isfinite(table).all():
        row = int((~np.isfinite(table)).any(axis=1).argmax())
        raise MotionFileError(f"{path}: row {row + 1} holds a number that is NaN or infinite")
    return table


def frame_rate(times: FloatArray, path: str | Path) -> float:
    """Return the frames per second of times (T) in s at equal steps."""
    steps = np.diff(times)
    if len(steps) == 0:
        raise MotionFileError(f"{path}: holds 1 frame, expected at least 2")
    mean = float(steps.mean())
    if mean <= 0.0 or np.abs(steps - mean).max() > _STEP_TOLERANCE * mean:
        raise MotionFileError(
            f"{path}: the time steps are {steps.min():g} to {steps.max():g} s, expected equal ones "
            "above 0"
        )
    return 1.0 / mean
