"""What the readers and writers of clips share: JSON, error texts, files that appear in one step."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.errors import MotionFileError, one_line
from isaacgymenvs_lite.utils import files


def read_json(path: str | Path) -> dict[str, Any]:
    """Return the JSON object in the file at `path`.

    Raises:
        MotionFileError: the file is no JSON text or holds no object.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise MotionFileError(
            f"{path}: is no JSON text ({one_line(error)}); expected a poselib or DeepMimic clip"
        ) from error
    if not isinstance(data, dict):
        raise MotionFileError(
            f"{path}: holds a JSON {type(data).__name__}, expected the object of a clip"
        )
    return data


@contextmanager
def written_clip(path: Path) -> Iterator[Path]:
    """Write a clip as `files.atomic_write` does, with errors that speak of a clip.

    Raises:
        MotionFileError: the folder is missing, cannot be written or is full.
    """
    try:
        with files.atomic_write(path) as partial:
            yield partial
    except OSError as error:
        reason = error.strerror or error
        raise MotionFileError(
            f"cannot write {path.absolute()} ({reason}); choose a folder that exists and has room"
        ) from error


def check_output(path: Path, suffixes: Collection[str], overwrite: bool) -> None:
    """Check the path of an output before any work is done for it.

    Args:
        path: of the file to write.
        suffixes: suffixes of the known formats.
        overwrite: an existing file may be replaced.

    Raises:
        MotionFileError: no such format or folder, or the file exists and may not be replaced.
    """
    if path.suffix not in suffixes:
        raise MotionFileError(
            f"{path}: the suffix determines the format of the output, found '{path.suffix}'; "
            f"choices: {', '.join(suffixes)}"
        )
    if not path.parent.is_dir():
        raise MotionFileError(f"{path}: the folder {path.parent.absolute()} does not exist")
    if path.exists() and not overwrite:
        raise MotionFileError(f"{path} exists already; overwrite=True replaces it")
