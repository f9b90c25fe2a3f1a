"""What the writers of clips share: files appear in one step, and none is replaced unasked."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from isaacgymenvs_lite.errors import MotionFileError


@contextmanager
def written_in_one_step(path: Path) -> Iterator[Path]:
    """Give a name beside `path` to write to; it becomes `path` at the end, or is removed.

    Raises:
        MotionFileError: the folder is missing, cannot be written or is full.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        reason = error.strerror or error
        raise MotionFileError(
            f"cannot write {path.absolute()} ({reason}); choose a folder that exists and has room"
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def check_output(path: Path, suffixes: Collection[str], overwrite: bool) -> None:
    """Refuse an output before the work that it takes is done.

    Args:
        path: of the file to write.
        suffixes: those of the known formats.
        overwrite: an existing file may be replaced.

    Raises:
        MotionFileError: no such format or folder, or the file exists and shall stay.
    """
    if path.suffix not in suffixes:
        raise MotionFileError(
            f"{path}: the suffix says the format of the output, found '{path.suffix}'; "
            f"choices: {', '.join(suffixes)}"
        )
    if not path.parent.is_dir():
        raise MotionFileError(f"{path}: the folder {path.parent.absolute()} does not exist")
    if path.exists() and not overwrite:
        raise MotionFileError(f"{path} exists already; overwrite=True replaces it")
