"""Ending a run on request: Ctrl-C (SIGINT) and SIGTERM finish the epoch and save."""

from __future__ import annotations

import logging
import signal
import threading
from types import FrameType
from typing import Any

log = logging.getLogger(__name__)


class StopRequest:
    """While active, turns the first Ctrl-C or SIGTERM into a request and the second into a stop.

    Attributes:
        requested: whether somebody asked for the end.
    """

    def __init__(self) -> None:
        self.requested = False
        self._former: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is not threading.main_thread():
            return self  # only the main thread may handle signals
        for number in (signal.SIGINT, signal.SIGTERM):
            self._former[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exc_info: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def ask(self) -> None:
        """Ask for the end, as the first signal does."""
        self.requested = True
        log.warning("ending after this epoch with a checkpoint")

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        name = signal.Signals(number).name
        log.warning("%s: ending after this epoch with a checkpoint; once more ends at once", name)
