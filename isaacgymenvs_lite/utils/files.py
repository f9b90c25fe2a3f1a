"""Writes files atomically, so that a file is complete or absent."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError

PARTIAL_FILE = r"\..+\.\d+\.partial"
"""Pattern of the names of temporary files; a killed process may leave such files."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to; rename it to `path`, or remove it after an error.

    The content reaches the disk before the file gets the name `path`, so that a crash leaves either
    the old file or the new file. A file or link that has the temporary path is removed first,
    because another user may have made it.

    Raises:
        OSError: the folder is missing, cannot be written or is full.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.unlink(missing_ok=True)  # a link is removed, its target stays
    partial.touch(exist_ok=False)
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def check_no_links(folder: Path, below: str = "") -> None:
    """Refuse links below a folder, because writing through them would change files elsewhere.

    Args:
        folder: the folder, which may be a link itself.
        below: the only subfolder that is written to; '' means that all may be written to.

    Raises:
        ConfigError: there is a link below the folder.
    """
    walk = os.walk(folder / below)
    found = (Path(top, name) for top, folders, files in walk for name in (*folders, *files))
    for path in itertools.chain([folder / below], found):
        if path.is_symlink() and path != folder:
            raise ConfigError(
                f"{path} is a link, through which files elsewhere would be written; replace the"
                " link by its target, or link the whole folder of the runs"
            )


@contextmanager
def written_for_user(path: Path, key: str) -> Iterator[Path]:
    """Write like `atomic_write`, and create the folder if it does not exist.

    Args:
        path: the file.
        key: the setting that contains the path, for the message.

    Raises:
        ConfigError: the folder cannot be made or written, or is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial:
            yield partial
    except OSError as error:
        raise ConfigError(f"{key}={path}: cannot be written ({error.strerror or error})") from error
