"""Writes files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; at the end it becomes `path`, or is removed.

    The content is on the disk before the file is renamed, so that a crash leaves the old file or
    the new one.

    Raises:
        OSError: the folder is missing, cannot be written or is full.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def written_for_user(path: Path, key: str) -> Iterator[Path]:
    """Do as `atomic_write` in a folder that is made if need be.

    Args:
        path: the file.
        key: setting that named it, for the message.

    Raises:
        ConfigError: the folder cannot be made or written, or is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial:
            yield partial
    except OSError as error:
        raise ConfigError(f"{key}={path}: cannot be written ({error.strerror or error})") from error
