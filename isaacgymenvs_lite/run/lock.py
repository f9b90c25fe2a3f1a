"""Keeps a second run out of a folder; the operating system ends the lock with its process."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
import sys
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError, one_line

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

log = logging.getLogger(__name__)

LOCK_FILE = ".lock"
# What a file system answers that has no locks, as some network mounts.
_NO_LOCKS = frozenset((errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL))
_MAX_HOLDER_BYTES = 200
# Windows refuses to read locked bytes: one behind the text is locked.
_LOCKED_BYTE = 2**20


class FolderInUseError(ConfigError):
    """Another run writes into the folder."""


class FolderLock:
    """An exclusive lock on a folder, released by `release` or by any end of the process.

    The lock is on a file in the folder that holds process and host for messages; a kill may leave
    the file behind, never the lock. On network file systems the lock holds between machines if the
    server supports locks; without any support one warning is logged.

    Args:
        folder: must exist.

    Raises:
        FolderInUseError: another run holds the lock.
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = folder / LOCK_FILE
        self._fd = self._open()
        while not self.is_intact():  # the former holder removed the file meanwhile
            os.close(self._fd)
            self._fd = self._open()
        with contextlib.suppress(OSError):  # a full disk: the lock holds without a name
            os.ftruncate(self._fd, 0)
            os.write(self._fd, f"process {os.getpid()} on {socket.gethostname()}\n".encode())

    def is_intact(self) -> bool:
        """Return whether the lock still protects the folder: its file was not removed."""
        try:
            return os.path.samestat(os.fstat(self._fd), self._file.stat(follow_symlinks=False))
        except OSError:
            return False

    def release(self) -> None:
        """Remove the file and end the lock."""
        if self.is_intact():  # another run may have its own by now
            with contextlib.suppress(OSError):
                self._file.unlink()
        with contextlib.suppress(OSError):
            os.close(self._fd)

    def _open(self) -> int:
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        fd = os.open(self._file, flags, 0o644)
        try:
            _lock(fd)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                log.warning(
                    "%s: this file system has no locks; do not start a second run in this folder",
                    self._folder,
                )
                return fd
            os.close(fd)
            if error.errno in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
                raise self._in_use() from error
            raise
        return fd

    def _in_use(self) -> FolderInUseError:
        try:
            with self._file.open("rb") as file:
                holder = one_line(file.read(_MAX_HOLDER_BYTES).decode(errors="replace"))
        except OSError:
            holder = ""
        return FolderInUseError(
            f"another run writes into {self._folder} ({holder or 'process unknown'}); wait for its"
            " end, or choose another experiment=NAME or +full_experiment_name=NAME"
        )


if sys.platform == "win32":

    def _lock(fd: int) -> None:
        os.lseek(fd, _LOCKED_BYTE, os.SEEK_SET)
        msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        os.lseek(fd, 0, os.SEEK_SET)

else:

    def _lock(fd: int) -> None:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
