"""Shows environment 0 in a window, MuJoCo's passive viewer with Isaac Gym's keys."""

from __future__ import annotations

import atexit
import logging
import queue
import string
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco

from isaacgymenvs_lite.rendering.display import check_display
from isaacgymenvs_lite.rendering.markers import add_markers
from isaacgymenvs_lite.rendering.tracks import PoseReader, PoseRecorder, markers_of
from isaacgymenvs_lite.rendering.view import aim_camera
from isaacgymenvs_lite.viewers.reference_overlay import ReferenceOverlay
from isaacgymenvs_lite.viewers.videos import VideoWriter

log = logging.getLogger(__name__)

KEY_NAMES = ("up", "down", "left", "right", "space", *string.ascii_lowercase, *string.digits)
"""Keys of a window or a page that `VecTask.on_key` can receive."""
# Largest number of control steps in a recording; they last more than a minute in every task.
_MAX_RECORDED = 10_000
_CLOSING_S = 5.0
# GLFW's key codes are ASCII codes for digits and capital letters.
_ESCAPE = 256
_NAMES = {265: "up", 264: "down", 263: "left", 262: "right", ord(" "): "space"} | {
    ord(name.upper()): name for name in KEY_NAMES if len(name) == 1
}


def press_key(env: Any, name: str) -> None:
    """Call a task's `on_key` if `KEY_NAMES` contains the key; call this between two steps."""
    if name in KEY_NAMES:
        env.on_key(name)


class Keys:
    """Passes keys from the window's thread to the task's thread; V, R and ESC have a state.

    Args:
        env: the task (`VecTask`), whose `on_key` receives all keys except V, R and ESC.
        to_task: whether `on_key` is called. It is False in a training, which must not depend on
            keys.

    Attributes:
        sync: whether the window shows each step, at most in real time; the key V changes it.
        recording: whether a video is being recorded; the key R changes it.
        quit: whether the user has pressed ESC, which ends the program.
    """

    HELP = "V: show every step on / off, R: record on / off, ESC: quit"

    def __init__(self, env: Any, to_task: bool = True) -> None:
        self.sync = True
        self.recording = False
        self.quit = False
        self._env, self._to_task = env, to_task
        self._pressed: queue.SimpleQueue[int] = queue.SimpleQueue()

    def press(self, key: int) -> None:
        """Queue the key with the GLFW code `key`; any thread may call this method."""
        self._pressed.put(key)

    def update(self) -> None:
        """Apply the keys pressed since the last call; call this method between two steps."""
        while not self._pressed.empty():
            key = self._pressed.get()
            if key == ord("V"):
                self.sync = not self.sync
            elif key == ord("R"):
                self.recording = not self.recording
            elif key == _ESCAPE:
                self.quit = True
            elif self._to_task:
                press_key(self._env, _NAMES.get(key, ""))


class WindowClosedError(Exception):
    """Ends a program that plays a policy, after its window was closed."""


class Window:
    """Shows environment 0 of a task in a window; a `StepListener`.

    Args:
        env: the task; the window also shows the reference of an imitation task.
        folder: folder for the videos of the key R.
        on_quit: function that is called in the task's thread after ESC or a closed window.
        every_step: whether the window shows every step. If it is False, the window changes only
            when `env.render()` is called.
        keys_to_task: whether the task's `on_key` receives keys.
    """

    def __init__(
        self,
        env: Any,
        folder: Path,
        on_quit: Callable[[], None],
        *,
        every_step: bool = True,
        keys_to_task: bool = True,
    ) -> None:
        check_display()
        from mujoco import viewer  # This import needs GLFW.

        self.keys = Keys(env, keys_to_task)
        self._env = env
        self._folder = folder
        self._on_quit = on_quit
        self._every_step = every_step
        self._read_pose = PoseReader(env)
        self._model: mujoco.MjModel = env.simulation.model
        self._data = mujoco.MjData(self._model)
        self._reference = ReferenceOverlay.for_task(env, self._model)
        self._markers_of = markers_of(env)
        self._video_writer = VideoWriter()
        self._recorder: PoseRecorder | None = None
        self._steps = 0
        self._has_ended = False
        self._next_step_s = time.monotonic()
        others = set(threading.enumerate())
        self._viewer: Any = viewer.launch_passive(
            self._model,
            self._data,
            key_callback=self.keys.press,
            show_left_ui=False,
            show_right_ui=False,
        )
        self._threads = set(threading.enumerate()) - others
        atexit.register(self.close)
        with self._viewer.lock():
            aim_camera(self._viewer.cam, self._model)
        log.info("%s", Keys.HELP)

    @property
    def keeps_playing(self) -> bool:
        """Whether the window is open."""
        return not self._has_ended

    def after_step(self) -> None:
        """Apply the keys; record the step if R, and show the step if V is switched on."""
        self._steps += 1
        self.keys.update()
        if not self._has_ended and (self.keys.quit or not self._viewer.is_running()):
            self._has_ended = True
            self._on_quit()
        self._record()
        if self._every_step and self.keys.sync:
            self.render()
            now = time.monotonic()
            time.sleep(max(0.0, self._next_step_s - now))
            self._next_step_s = max(self._next_step_s, now) + self._env.simulation.dt

    def render(self) -> None:
        """Show the current state."""
        if not self._viewer.is_running():
            return
        with self._viewer.lock():
            qpos = self._read_pose(0)
            self._data.qpos[:] = qpos
            mujoco.mj_forward(self._model, self._data)
            scene = self._viewer.user_scn
            scene.ngeom = 0
            if self._reference is not None:
                self._reference.add_to(scene, qpos)
            add_markers(scene, self._markers_of(0))
        self._viewer.sync()

    def _record(self) -> None:
        if self.keys.recording:
            if self._recorder is None:
                log.info("recording; R once more ends it")
                self._recorder = PoseRecorder(self._env, _MAX_RECORDED)
            self._recorder.step()
        elif self._recorder is not None:
            self._end_recording()

    def _end_recording(self) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            log.error("cannot make the video folder %s (%s)", self._folder, error.strerror)
            return
        path = self._folder / f"window-step-{self._steps}.mp4"
        self._video_writer.make(self._env, recorder, path)

    def close(self) -> None:
        """Write the running recording and close the window; a second call does nothing."""
        atexit.unregister(self.close)
        self._end_recording()
        self._video_writer.close()
        self._viewer.close()
        # A process that ends while the window draws crashes.
        for thread in self._threads:
            thread.join(_CLOSING_S)
