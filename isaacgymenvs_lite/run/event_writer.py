"""Writes TensorBoard events without blocking or stopping a training run.

tensorboardX passes events to a thread through a queue of ten. The thread dies if the disk is full;
then `add_scalar` and the end of the process wait for ever. In this module the thread that adds an
event also writes it. A failure is logged once, and the events are kept and written later.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
import time
from pathlib import Path
from typing import Any

from tensorboardX.proto import event_pb2
from tensorboardX.record_writer import masked_crc32c

_log = logging.getLogger(__name__)

# protobuf makes these classes at run time.
Event: Any = event_pb2.Event  # type: ignore[attr-defined]
SessionLog: Any = event_pb2.SessionLog  # type: ignore[attr-defined]

# About 20,000 scalars wait for space on a full disk; later scalars are dropped.
_MAX_WAITING_BYTES = 2**20
_FLUSH_S = 10.0
# Largest size of a file of tensorboardX that contains no scalars.
_HEADER_BYTES = 100


class RetryingEventWriter:
    """Replaces tensorboardX's `EventFileWriter`; restores the log folder if somebody removes it."""

    def __init__(self, logdir: str | os.PathLike[str]) -> None:
        self._logdir = Path(logdir)
        # Programs that read the file use the time of this header as the start of the run.
        version = Event(wall_time=time.time(), file_version="brain.Event:2")
        self._header = _record(version)
        self._waiting = bytearray()
        self._failing = False
        self._fd: int | None = None
        self._next_flush = 0.0

    def get_logdir(self) -> str:
        """Return the folder of the event file."""
        return str(self._logdir)

    def add_event(self, event: Any) -> None:
        """Add an event, which is written within ten seconds or as soon as the disk has space."""
        if len(self._waiting) < _MAX_WAITING_BYTES:
            self._waiting += _record(event)
        if time.monotonic() >= self._next_flush:
            self.flush()

    def flush(self) -> None:
        """Write the waiting events; log the first OSError and the end of the failure."""
        self._next_flush = time.monotonic() + _FLUSH_S
        try:
            self._write()
        except OSError as error:
            if not self._failing:
                _log.warning(
                    "TensorBoard scalars cannot be written to %s (%s); training goes on, "
                    "the scalars are kept until the folder can be written again",
                    *(self._logdir, error.strerror),
                )
            self._failing = True
        else:
            if self._failing:
                _log.warning("TensorBoard scalars are written again")
            self._failing = False

    def close(self) -> None:
        """Flush and close the file; a second call does nothing."""
        self.flush()
        if self._fd is not None:
            with contextlib.suppress(OSError):
                os.close(self._fd)
        self._fd = None

    def _write(self) -> None:
        if self._fd is not None and os.fstat(self._fd).st_nlink == 0:
            os.close(self._fd)  # somebody removed the file
            self._fd = None
        if not self._waiting:
            return
        if self._fd is None:
            self._logdir.mkdir(parents=True, exist_ok=True)
            host, now = socket.gethostname(), time.time_ns() // 10**9
            path = self._logdir / f"events.out.tfevents.{now}.{host}.{os.getpid()}"
            self._fd = os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o666)
        good = os.fstat(self._fd).st_size
        data = bytes(self._waiting) if good else self._header + bytes(self._waiting)
        try:
            written = 0
            while written < len(data):
                written += os.write(self._fd, data[written:])
        except OSError:
            # Programs that read the file stop at an incomplete record, so it is removed.
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, good)
            raise
        self._waiting.clear()


def install(writer: Any) -> None:
    """Make a tensorboardX `SummaryWriter` write through a `RetryingEventWriter`.

    Call this function before the first scalar, because it closes and removes tensorboardX's file.
    """
    file_writer = writer.file_writer
    old = file_writer.event_writer
    if isinstance(old, RetryingEventWriter):
        return
    with contextlib.suppress(OSError):
        old.close()
        for header in Path(old.get_logdir()).glob("events.out.tfevents.*"):
            if header.stat().st_size <= _HEADER_BYTES:
                header.unlink()
    # FileWriter's exit handler closes `event_writer`; closing a RetryingEventWriter cannot hang.
    file_writer.event_writer = RetryingEventWriter(old.get_logdir())


def continue_log(writer: Any, frame: int) -> None:
    """Make TensorBoard drop scalars from `frame` on, because the resumed run writes them again."""
    if hasattr(writer, "file_writer"):  # only the main process has a file
        start = SessionLog(status=SessionLog.START)
        event = Event(wall_time=time.time(), step=frame, session_log=start)
        writer.file_writer.event_writer.add_event(event)


def _record(event: Any) -> bytes:
    """Frame an event as a TFRecord: length, its checksum, data, its checksum."""
    data = event.SerializeToString()
    length = struct.pack("<Q", len(data))
    checksums = (struct.pack("<I", masked_crc32c(part)) for part in (length, data))
    return length + next(checksums) + data + next(checksums)
