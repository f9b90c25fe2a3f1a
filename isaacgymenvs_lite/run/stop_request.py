"""Ends a run after the current epoch, with a checkpoint, if the user or the system requests it."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from isaacgymenvs_lite.distributed import started_by_torchrun
from isaacgymenvs_lite.errors import StoppedAtOnceError

log = logging.getLogger(__name__)

# An ssh session or a terminal sends SIGHUP when it closes. Windows does not have this signal.
_HANGUP = getattr(signal, "SIGHUP", None)
# torchrun passes signals on, so a process receives a terminal's signal twice.
_SAME_SIGNAL_S = 2.0


class StopRequest:
    """Turns the first Ctrl-C or SIGTERM into a request and the second into a StoppedAtOnceError.

    A `with` statement installs the signal handlers. SIGHUP is always a request, because a closing
    session may send SIGHUP several times. A process that nohup has started ignores SIGHUP.

    Attributes:
        requested: whether the run should end after this epoch.
    """

    def __init__(self) -> None:
        self.requested = False
        self._former: dict[int, Any] = {}
        self._repeats_until_s = 0.0

    def __enter__(self) -> StopRequest:
        self._former = _install_handlers((signal.SIGINT, signal.SIGTERM), self._handle)
        return self

    def __exit__(self, *exc_info: object) -> None:
        _restore_handlers(self._former)

    def request(self) -> None:
        """Request the end of the run, as the first signal does."""
        self.requested = True
        log.warning("ending after this epoch with a checkpoint")

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            if number == _HANGUP or time.monotonic() < self._repeats_until_s:
                return
            raise StoppedAtOnceError(number)
        self.requested = True
        if started_by_torchrun():
            self._repeats_until_s = time.monotonic() + _SAME_SIGNAL_S
        name = signal.Signals(number).name
        log.warning(
            "%s: ending after this epoch with a checkpoint; a second %s ends at once", name, name
        )


@contextmanager
def signals_as_ctrl_c() -> Iterator[None]:
    """Make SIGTERM and SIGHUP raise KeyboardInterrupt once, like Ctrl-C.

    The training loops of other libraries save a checkpoint at a KeyboardInterrupt.
    """
    raised = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal raised
        if not raised:
            raised = True
            raise KeyboardInterrupt

    former = _install_handlers((signal.SIGTERM,), handle)
    try:
        yield
    finally:
        _restore_handlers(former)


def _install_handlers(numbers: tuple[int, ...], handler: Any) -> dict[int, Any]:
    """Install a handler for signals, except for an ignored SIGHUP; return the former handlers."""
    if threading.current_thread() is not threading.main_thread():
        return {}  # only the main thread may handle signals
    if _HANGUP is not None and signal.getsignal(_HANGUP) is not signal.SIG_IGN:
        numbers = (*numbers, _HANGUP)
    return {number: signal.signal(number, handler) for number in numbers}


def _restore_handlers(former: dict[int, Any]) -> None:
    for number, handler in former.items():
        signal.signal(number, handler)
