"""Videos of a training or a play, recorded at regular intervals.

Recording copies the state of the shown environments, some dozens of numbers. Drawing and encoding
take a hundred times as long and run in a thread (`VideoWriter`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.viewers.video_writer import VideoJob, VideoWriter


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
