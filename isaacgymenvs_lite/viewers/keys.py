"""What the keys of Isaac Gym's viewer mean for a window, apart from any window."""

from __future__ import annotations

import queue

# GLFW's key codes: letters are their capitals' ASCII codes.
_ESCAPE = 256


class Keys:
    """Hears keys in the window's thread; answers in the one that steps the task.

    Attributes:
        sync: V: whether the window shows each step, no faster than what it simulates.
        recording: R: whether a video is being recorded.
        quit: ESC: whether somebody asked for the end.
    """

    HELP = "V: show every step on / off, R: record on / off, ESC: quit"

    def __init__(self) -> None:
        self.sync = True
        self.recording = False
        self.quit = False
        self._pressed: queue.SimpleQueue[int] = queue.SimpleQueue()

    def press(self, key: int) -> None:
        """Hear a key, by GLFW's code; may be called in any thread."""
        self._pressed.put(key)

    def update(self) -> None:
        """Let the keys pressed since the last call have their effect."""
        while not self._pressed.empty():
            key = self._pressed.get()
            if key == ord("V"):
                self.sync = not self.sync
            elif key == ord("R"):
                self.recording = not self.recording
            elif key == _ESCAPE:
                self.quit = True
