"""Tables of numbers as `.csv` text: what the clips that are tables share.

A header names each column and, in brackets, its unit: `time [s]`, `root_x [m]`.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from isaacgymenvs_lite.errors import MotionFileError, one_line
from isaacgymenvs_lite.motion.formats.files import MAX_TEXT_BYTES, read_bytes, written_clip
from isaacgymenvs_lite.motion.kinematics import FloatArray

TIME = "time"
POSITION = ("root_x", "root_y", "root_z")
ROTATION = ("root_qx", "root_qy", "root_qz", "root_qw")
# Factors to the unit of the clip; the first of each kind is the one that is written.
TIME_UNITS = {"s": 1.0, "ms": 1e-3}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180.0}
ROOT_UNITS: Mapping[str, Mapping[str, float]] = {
    TIME: TIME_UNITS,
    **dict.fromkeys(POSITION, LENGTH_UNITS),
    **{name: {} for name in ROTATION},
}
"""The units of the time and of the root's columns; none for quaternions."""
_COLUMN = re.compile(r"\s*(?P<name>[^\[\]]*?)\s*(\[\s*(?P<unit>[^\[\]]*?)\s*\])?\s*")
_FPS_LINE = re.compile(r"#\s*fps\s*[:=]\s*(?P<fps>\S+)\s*", re.IGNORECASE)
# How much a time step may differ from the others; times are often rounded to milliseconds.
_STEP_TOLERANCE = 0.1
# The humanoid with sword and shield has 39 columns.
_MAX_COLUMNS, _MAX_COLUMN_LENGTH = 200, 200
_MAX_LINES = 200_000


def read_lines(path: Path) -> tuple[list[list[str]], float | None]:
    """Return the cells of all lines but comments, and the rate of the line `# fps:` or None.

    Raises:
        MotionFileError: no CSV text, fewer than two lines, too many lines or columns.
    """
    comments, kept = [], []
    try:
        text = read_bytes(path, MAX_TEXT_BYTES).decode("utf-8-sig")
        for number, line in enumerate(io.StringIO(text, newline=None)):
            if number > _MAX_LINES:
                raise MotionFileError(
                    f"{path}: has more than {_MAX_LINES:,} lines; cut it into several clips"
                )
            if line.startswith("#"):
                comments.append(line[:_MAX_COLUMN_LENGTH].rstrip("\n"))
            elif line.strip():
                kept.append(line)
        lines = list(csv.reader(kept))
    except (UnicodeDecodeError, csv.Error) as error:
        raise MotionFileError(f"{path}: is no CSV text ({one_line(error)})") from error
    if len(lines) < 2:
        raise MotionFileError(
            f"{path}: holds {len(lines)} line(s), expected a header and rows of numbers"
        )
    if len(lines[0]) > _MAX_COLUMNS or max(map(len, lines[0])) > _MAX_COLUMN_LENGTH:
        raise MotionFileError(
            f"{path}: the header has {len(lines[0])} columns with names of up to "
            f"{max(map(len, lines[0]))} characters, expected at most {_MAX_COLUMNS} and "
            f"{_MAX_COLUMN_LENGTH}"
        )
    rates = [match["fps"] for line in comments if (match := _FPS_LINE.fullmatch(line))]
    try:
        return lines, float(rates[0]) if rates else None
    except ValueError as error:
        raise MotionFileError(f"{path}: fps is {rates[0]!r}, expected a number") from error


def split_header(cells: Sequence[str], path: str | Path) -> tuple[list[str], list[str | None]]:
    """Return the names and the units of the columns of a header.

    Raises:
        MotionFileError: a column that is not like `name [unit]`, or a name that occurs twice.
    """
    header = [_COLUMN.fullmatch(text) for text in cells]
    if not all(header):
        raise MotionFileError(f"{path}: the header has a column that is not like 'name [unit]'")
    return [match["name"] for match in header if match], [m["unit"] for m in header if m]


def check_double(names: Sequence[str], path: str | Path) -> None:
    """Raise a MotionFileError if a header names a column twice."""
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise MotionFileError(f"{path}: the header names {', '.join(double)} twice")


def unit_factor(
    name: str, unit: str | None, choices: Mapping[str, float], path: str | Path
) -> float:
    """Return the factor of a column's unit; 1 for a column that has no units.

    Raises:
        MotionFileError: the unit is none of `choices`.
    """
    if choices and unit not in choices:
        given = "no unit" if unit is None else f"the unit '{unit}'"
        raise MotionFileError(
            f"{path}: the column '{name}' has {given}; choices: "
            + ", ".join(f"'{name} [{choice}]'" for choice in choices)
        )
    return choices[unit] if choices and unit else 1.0


def numbers(rows: list[list[str]], width: int, path: str | Path, like: str = "") -> FloatArray:
    """Return the rows (T, width) as finite numbers.

    Args:
        rows: cells, without the header.
        width: the expected number of cells.
        path: of the file, for messages.
        like: what determines the width, for the message; by default the header.

    Raises:
        MotionFileError: a row of another width, or a cell that is no finite number.
    """
    for i, row in enumerate(rows):
        if len(row) != width:
            raise MotionFileError(
                f"{path}: row {i + 1} has {len(row)} values, expected {width} as in "
                f"{like or 'the header'}"
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
    """Return the frames per second of times (T) in s.

    Raises:
        MotionFileError: one frame only, or unequal steps.
    """
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


def write_table(
    path: str | Path, columns: Mapping[str, Mapping[str, float]] | None, table: FloatArray
) -> Path:
    """Write a table in one step, 12 digits a number; returns the path.

    Args:
        path: of the file.
        columns: the names of all columns and the units each may have, of which the first is
            written; None: no header.
        table: (T, number of columns), in these units.

    Raises:
        MotionFileError: the file cannot be written.
    """
    path = Path(path)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if columns is not None:
        writer.writerow(
            f"{name} [{next(iter(units))}]" if units else name for name, units in columns.items()
        )
    writer.writerows([f"{value:.12g}" for value in row] for row in table.tolist())
    with written_clip(path) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8")
    return path
