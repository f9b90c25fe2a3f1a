"""What the writers of clips share: files appear in one step, and none is replaced unasked."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.utils import files


@contextmanager
def written_clip(path: Path) -> Iterator[Path]:
    """Do as `files.atomic_write` does, and say it of a clip if that fails.

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
