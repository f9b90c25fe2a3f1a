"""Functions that readers and writers of clips share: one-line errors and atomic writing."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError, UserError, one_line
from isaacgymenvs_lite.utils import files


@contextmanager
def reading(path: str | Path, kind: str) -> Iterator[None]:
    """Convert any exception of a reader into a MotionFileError that names the file and its kind.

    numpy's overflow warnings are silenced, because `validate` refuses infinite values.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except UserError:
        raise
    except FileNotFoundError as error:
        raise MotionFileError(f"{path}: no such file") from error
    except Exception as error:  # The readers raise exceptions of many types.
        reason = one_line(error) or type(error).__name__
        raise MotionFileError(f"{path}: is no {kind} that can be read ({reason})") from error


def native_floats(array: npt.NDArray[Any]) -> npt.NDArray[np.floating]:
    """Convert an array to float32 or float64 in the machine's byte order.

    float16 becomes float32; integers and long doubles become float64.
    """
    if array.dtype in (np.float32, np.float64) and array.dtype.isnative:
        return array
    is_short = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return array.astype(np.float32 if is_short else np.float64)


def read_json(path: str | Path) -> dict[str, Any]:
    """Return the JSON object in the file at `path`."""
    with reading(path, "JSON text of a poselib or DeepMimic clip"):
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    if not isinstance(data, dict):
        raise MotionFileError(
            f"{path}: holds a JSON {type(data).__name__}, expected the object of a clip; write a"
            " table of numbers as .csv"
        )
    return data


@contextmanager
def written_clip(path: Path) -> Iterator[Path]:
    """Yield a temporary path; after the `with` block, the file at this path replaces `path`."""
    try:
        with files.atomic_write(path) as partial:
            yield partial
    except OSError as error:
        reason = error.strerror or error
        raise MotionFileError(
            f"cannot write {path.absolute()} ({reason}); choose a folder that exists and has room"
        ) from error


def check_output(path: Path, suffixes: Collection[str], overwrite: bool) -> None:
    """Raise a MotionFileError if the output path cannot be written."""
    if path.suffix not in suffixes:
        raise MotionFileError(
            f"{path}: the suffix determines the format of the output, found '{path.suffix}'; "
            f"choices: {', '.join(suffixes)}"
        )
    if not path.parent.is_dir():
        raise MotionFileError(f"{path}: the folder {path.parent.absolute()} does not exist")
    if path.exists() and not overwrite:
        raise MotionFileError(f"{path} exists already; overwrite=True replaces it")
