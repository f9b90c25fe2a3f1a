"""Videos of a training's first environment, now and then."""

from __future__ import annotations

import logging
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.optional_packages import require
from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.rendering.video import draw_tracks, save_video
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

log = logging.getLogger(__name__)

_WIDTH, _HEIGHT = 480, 360


class VideoRecorder:
    """Films `length` control steps from every `interval`-th on: `<folder>/step_<n>.mp4`.

    Args:
        stepper: steps the task.
        folder: for the files; made if it does not exist.
        length: control steps in a video.
        interval: control steps from the beginning of one to that of the next.

    Raises:
        ConfigError: the folder cannot be written.
        MissingPackageError: there is no encoder.
        RenderingError: this machine cannot draw.
    """

    def __init__(self, stepper: AutoresetTask, folder: Path, length: int, interval: int) -> None:
        require("av", "--video")
        ensure_gl()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"cannot write the videos' folder {folder.absolute()} ({error.strerror or error})"
            ) from error
        self._task = stepper.task
        self._folder = folder
        self._length, self._interval = length, interval
        self._steps = 0
        self._recorder: PoseRecorder | None = None
        self._left = 0
        stepper.after_step.append(self._step)

    def _step(self) -> None:
        if self._recorder is None and self._steps % self._interval == 0:
            self._recorder = PoseRecorder(self._task, self._length)
            self._left = self._length
        self._steps += 1
        if self._recorder is not None:
            self._recorder.step()
            self._left -= 1
            if self._left == 0:
                self.finish()

    def finish(self) -> None:
        """Write the video that is being recorded, if there is one."""
        if self._recorder is None:
            return
        recorder, self._recorder = self._recorder, None
        tracks, model = recorder.tracks(), self._task.simulation.model
        images = draw_tracks(model, tracks, marks=recorder.marks(), width=_WIDTH, height=_HEIGHT)
        path = self._folder / f"step_{self._steps - len(tracks[0])}.mp4"
        save_video(path, images, 1.0 / self._task.simulation.dt)
        log.info("video: %s", path)
