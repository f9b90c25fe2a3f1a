"""A window on a display: MuJoCo's passive viewer, with Isaac Gym's keys, for environment 0."""

from __future__ import annotations

import atexit
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco

from isaacgymenvs_lite.rendering.display import check_display
from isaacgymenvs_lite.rendering.tracks import PoseReader, PoseRecorder
from isaacgymenvs_lite.rendering.view import aim_camera
from isaacgymenvs_lite.viewers.keys import Keys
from isaacgymenvs_lite.viewers.reference_overlay import ReferenceOverlay, RobotOverlay
from isaacgymenvs_lite.viewers.video_writer import VideoJob, VideoWriter

log = logging.getLogger(__name__)

# Control steps that a recording may have; a minute and more of every task.
_MAX_RECORDED = 10_000
_CLOSING_S = 5.0


class WindowClosedError(Exception):
    """A play ends because its window was closed."""


class Window:
    """Shows environment 0 of a task in a window; a `StepListener`.

    Args:
        env: the task; the reference of one that imitates is shown beside the character.
        folder: where R puts videos.
        on_quit: called in the task's thread when ESC was pressed or the window closed.
        every_step: show every step; False: only when `env.render()` is called.

    Raises:
        ConfigError: there is no display.
    """

    def __init__(
        self, env: Any, folder: Path, on_quit: Callable[[], None], *, every_step: bool = True
    ) -> None:
        check_display()
        from mujoco import viewer  # needs GLFW

        self.keys = Keys()
        self._env = env
        self._folder = folder
        self._on_quit = on_quit
        self._every_step = every_step
        self._read_pose = PoseReader(env)
        self._model: mujoco.MjModel = env.simulation.model
        self._data = mujoco.MjData(self._model)
        self._ghost = ReferenceOverlay(env) if hasattr(env, "motion_lib") else None
        self._painter = RobotOverlay(self._model)
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
        """Obey the keys; record and show the step if they say so."""
        self._steps += 1
        self.keys.update()
        if not self._has_ended and (self.keys.quit or not self._viewer.is_running()):
            self._has_ended = True
            self._on_quit()
        self._record()
        if self._every_step and self.keys.sync:
            self.render()
            self._wait()

    def render(self) -> None:
        """Show the present state."""
        if not self._viewer.is_running():
            return
        with self._viewer.lock():
            qpos = self._read_pose(0)
            self._data.qpos[:] = qpos
            mujoco.mj_forward(self._model, self._data)
            if self._ghost is not None:
                scene = self._viewer.user_scn
                scene.ngeom = 0
                self._painter.add_to(scene, self._ghost.pose(qpos))
        self._viewer.sync()

    def _wait(self) -> None:
        """Be no faster than what is simulated."""
        now = time.monotonic()
        time.sleep(max(0.0, self._next_step_s - now))
        self._next_step_s = max(self._next_step_s, now) + self._env.simulation.dt

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
        self._video_writer.make(VideoJob.from_recording(self._env, recorder, path))

    def close(self) -> None:
        """Close the window, after what was recorded is written; a second call does nothing."""
        atexit.unregister(self.close)
        self._end_recording()
        self._video_writer.close()
        self._viewer.close()
        # A window that still draws when the process ends takes it down.
        for thread in self._threads:
            thread.join(_CLOSING_S)
