"""Videos of a training or a play, recorded at regular intervals.

Recording copies the state of the shown environments, some dozens of numbers. Drawing and encoding
take a hundred times as long and run in a thread (`VideoWriter`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.rendering.video import check_encoder
from isaacgymenvs_lite.viewers.video_writer import VideoJob, VideoWriter

log = logging.getLogger(__name__)


def capture_videos(
    env: Any,
    folder: Path,
    *,
    every: int,
    length: int,
    num_envs: int = 1,
    prefix: str = "rl-video",
    on_done: Callable[[Path], None] | None = None,
) -> VideoCapture:
    """Start to record a task; closing the task, or the result, finishes the current video.

    Args:
        env: the task.
        folder: where the files go; made if it does not exist.
        every: see `VideoCapture`.
        length: see `VideoCapture`.
        num_envs: see `VideoCapture`.
        prefix: see `VideoCapture`.
        on_done: called with the path of each video, in another thread.

    Raises:
        ConfigError: the folder cannot be written, or there is no encoder.
        RenderingError: this machine cannot draw.
    """
    check_encoder()
    ensure_gl()
    make_video_folder(folder)
    log.info("videos go to %s", folder)
    capture = VideoCapture(
        env,
        VideoWriter(on_done),
        folder,
        every=every,
        length=length,
        num_envs=num_envs,
        prefix=prefix,
    )
    env.listeners.append(capture)
    return capture


def make_video_folder(folder: Path) -> None:
    """Make a folder and check that files can be written into it.

    Raises:
        ConfigError: they cannot.
    """
    trial = folder / ".trial"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        trial.touch()
        trial.unlink()
    except OSError as error:
        raise ConfigError(
            f"cannot write the video folder {folder.absolute()} ({error.strerror or error}); choose"
            " another folder of runs, for train.py with +train.params.config.train_dir=FOLDER, or"
            " record no videos"
        ) from error


class VideoCapture:
    """Records a task at regular intervals; a `StepListener`.

    Args:
        env: the task.
        video_writer: draws the recordings.
        folder: where the files go; it exists.
        every: control steps from the start of one recording to the start of the next.
        length: control steps of a recording.
        num_envs: number of environments that are shown, in tiles.
        prefix: the files are called `<prefix>-step-<steps made before>.mp4`.
    """

    def __init__(
        self,
        env: Any,
        video_writer: VideoWriter,
        folder: Path,
        *,
        every: int,
        length: int,
        num_envs: int = 1,
        prefix: str = "rl-video",
    ) -> None:
        self._env = env
        self._video_writer = video_writer
        self._folder = folder
        self._every = every
        self._length = length
        self._env_ids = range(min(num_envs, env.num_envs))
        self._prefix = prefix
        self._steps = 0
        self._first_step = 0
        self._recorder: PoseRecorder | None = None

    def after_step(self) -> None:
        """Record the step if it belongs to a recording."""
        if self._recorder is None and self._steps % self._every == 0:
            self._first_step = self._steps
            self._recorder = PoseRecorder(self._env, self._length, self._env_ids)
        self._steps += 1
        if self._recorder is not None:
            self._recorder.step()
            if self._steps - self._first_step >= self._length:
                self._finish()

    def render(self) -> None:
        """Do nothing: recordings do not depend on windows."""

    def close(self) -> None:
        """End the current recording, and wait until all videos are written."""
        self._finish()
        self._video_writer.close()

    def _finish(self) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            name = f"{self._prefix}-step-{self._first_step}.mp4"
            job = VideoJob.from_recording(self._env, recorder, self._folder / name)
            self._video_writer.make(job)
