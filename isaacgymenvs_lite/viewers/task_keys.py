"""Keys that are pressed in a window or in a page, for `VecTask.on_key`."""

from __future__ import annotations

import string
import time
from typing import Any

KEY_NAMES = ("up", "down", "left", "right", "space", *string.ascii_lowercase, *string.digits)
"""What a task can receive."""

# Faster than people type; whoever opens a page can send more.
_MAX_PER_S = 20.0


class TaskKeys:
    """Passes keys on to a task, at most 20 a second and only `KEY_NAMES`.

    Args:
        env: the task (`VecTask`).
        are_passed: False drops all keys: a viewer must not change what a training learns.
    """

    def __init__(self, env: Any, are_passed: bool = True) -> None:
        self._env = env
        self._are_passed = are_passed
        # Keys that may come at once, after a pause.
        self._allowance = _MAX_PER_S
        self._last_s = time.monotonic()

    def press(self, name: str) -> None:
        """Call the task's `on_key`, or drop the key; call it between two steps."""
        if not self._are_passed or name not in KEY_NAMES:
            return
        now = time.monotonic()
        earned = _MAX_PER_S * (now - self._last_s)
        self._allowance, self._last_s = min(_MAX_PER_S, self._allowance + earned), now
        if self._allowance >= 1.0:
            self._allowance -= 1.0
            self._env.on_key(name)
