"""Keys that are pressed in a window or in a page, for `VecTask.on_key`."""

from __future__ import annotations

import string
from typing import Any

KEY_NAMES = ("up", "down", "left", "right", "space", *string.ascii_lowercase, *string.digits)
"""What a task can receive."""


class TaskKeys:
    """Passes the keys of `KEY_NAMES` on to a task.

    Args:
        env: the task (`VecTask`).
        are_passed: False drops all keys: a viewer must not change what a training learns.
    """

    def __init__(self, env: Any, are_passed: bool = True) -> None:
        self._env = env
        self._are_passed = are_passed

    def press(self, name: str) -> None:
        """Call the task's `on_key`, or drop the key; call it between two steps."""
        if self._are_passed and name in KEY_NAMES:
            self._env.on_key(name)
