"""Ending a run on request: Ctrl-C, SIGTERM and the end of the session finish the epoch and save."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

log = logging.getLogger(__name__)

# Of an ssh session or a terminal that closes; Windows has none.
_HANGUP = getattr(signal, "SIGHUP", None)


class StopRequest:
    """While active, turns the first Ctrl-C or SIGTERM into a request and the second into a stop.

    A SIGHUP is a request, too, and never more than that: a session that ends may send several. Who
    was started by nohup, which ignores it, goes on.

    Attributes:
        requested: whether somebody asked for the end.
    """

    def __init__(self) -> None:
        self.requested = False
        self._former: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        self._former = _handle_all((signal.SIGINT, signal.SIGTERM), self._handle)
        return self

    def __exit__(self, *exc_info: object) -> None:
        _put_back(self._former)

    def ask(self) -> None:
        """Ask for the end, as the first signal does."""
        self.requested = True
        log.warning("ending after this epoch with a checkpoint")

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.requested:
            if number == _HANGUP:
                return
            raise KeyboardInterrupt
        self.requested = True
        name = signal.Signals(number).name
        log.warning("%s: ending after this epoch with a checkpoint; once more ends at once", name)


@contextmanager
def signals_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM and SIGHUP do what Ctrl-C does: raise KeyboardInterrupt, once.

    For trainings in loops of others, which save when they see it.
    """
    raised = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal raised
        del number, frame
        if not raised:
            raised = True
            raise KeyboardInterrupt

    former = _handle_all((signal.SIGTERM,), handle)
    try:
        yield
    finally:
        _put_back(former)


def _handle_all(numbers: tuple[int, ...], handler: Any) -> dict[int, Any]:
    """Let `handler` have signals, SIGHUP too unless it is ignored; return who had them before."""
    if threading.current_thread() is not threading.main_thread():
        return {}  # only the main thread may handle signals
    if _HANGUP is not None and signal.getsignal(_HANGUP) is not signal.SIG_IGN:
        numbers = (*numbers, _HANGUP)
    return {number: signal.signal(number, handler) for number in numbers}


def _put_back(former: dict[int, Any]) -> None:
    for number, handler in former.items():
        signal.signal(number, handler)
