"""Draws and encodes videos of a task in a thread, so that the task does not wait.

Recording copies only some dozens of values per step. Drawing and encoding a step take a hundred
times as long as recording it.
"""

from __future__ import annotations

import logging
import math
import queue
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco

from isaacgymenvs_lite.errors import ConfigError, UserError
from isaacgymenvs_lite.rendering.markers import Marker
from isaacgymenvs_lite.rendering.tracks import PoseRecorder, Track
from isaacgymenvs_lite.rendering.video import draw_tracks, save_video
from isaacgymenvs_lite.rendering.view import View

log = logging.getLogger(__name__)

SINGLE_SIZE, TILE_SIZE = (640, 480), (320, 240)
"""Pixels of a video of one environment, and of each tile in a video of several environments."""
# Largest number of waiting videos; their poses take memory.
_MAX_WAITING = 8


class VideoJob(NamedTuple):
    """The content of a video.

    Attributes:
        path: path of the .mp4 file. If the file exists, a number is added to the new file's name.
        model: model of the robots.
        dt_s: time between pictures in s.
        tracks: a track (T, nq) for each robot.
        markers: markers at each time for each track.
        follow: whether each camera follows its robot.
    """

    path: Path
    model: mujoco.MjModel
    dt_s: float
    tracks: Sequence[Track]
    markers: Sequence[Sequence[Sequence[Marker]]]
    follow: bool


class VideoWriter:
    """Writes videos one after the other, in a thread that starts with the first video.

    If a video cannot be written, the log reports the error and the training continues. The thread
    calls `on_done` with the path of each video.
    """

    def __init__(self, on_done: Callable[[Path], None] | None = None) -> None:
        self._on_done = on_done
        self._waiting: queue.Queue[VideoJob | None] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._left_out = 0

    def make(self, env: Any, recorder: PoseRecorder, path: Path) -> None:
        """Queue a recording of a task, or drop the recording if too many videos are waiting.

        The camera does not move if `task.env.cameraFollow` is False.
        """
        if self._waiting.qsize() >= _MAX_WAITING:
            self._left_out += 1
            if self._left_out == 1:
                log.warning(
                    "videos are recorded faster than they are drawn: leaving out %s and maybe"
                    " others; raise capture_video_freq or lower capture_video_len",
                    path.name,
                )
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="videos", daemon=True)
            self._thread.start()
        simulation = env.simulation
        follow = bool(env.cfg["env"].get("cameraFollow", True))
        tracks, markers = recorder.tracks(), recorder.markers()
        self._waiting.put(VideoJob(path, simulation.model, simulation.dt, tracks, markers, follow))

    def close(self) -> None:
        """Wait until all videos are written; a second call does nothing."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        if self._waiting.qsize() > 0:
            log.info("drawing the videos that are left: %d", self._waiting.qsize())
        self._waiting.put(None)
        thread.join()

    def _work(self) -> None:
        while (job := self._waiting.get()) is not None:
            try:
                path = write_video(job)
            except UserError as error:
                log.error("%s", error)
            except Exception:
                log.exception("the video %s could not be made", job.path)
            else:
                log.info("wrote %s", path)
                if self._on_done is not None:
                    self._on_done(path)


def write_video(job: VideoJob) -> Path:
    """Draw and encode a video; return the path of the written file."""
    count = len(job.tracks)
    width, height = SINGLE_SIZE if count == 1 else TILE_SIZE
    images = draw_tracks(
        job.model,
        job.tracks,
        markers=job.markers,
        width=width,
        height=height,
        columns=math.ceil(math.sqrt(count)),
        view=View.of_model(job.model),
        follow=job.follow,
    )
    number, free = 1, job.path
    while free.exists():
        number += 1
        free = job.path.with_stem(f"{job.path.stem}-{number}")
    return save_video(free, images, 1.0 / job.dt_s)


def make_video_folder(folder: Path) -> None:
    """Make a folder for videos.

    Raises:
        ConfigError: files cannot be written into the folder.
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
        video_writer: draws and encodes the recordings.
        folder: existing folder for the files.
        every: number of control steps from the start of a recording to the start of the next.
        length: number of control steps in a recording.
        num_envs: number of environments, which a video shows in tiles.
        prefix: prefix of the names `<prefix>-step-<control steps before the recording>.mp4`.
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
        """Record the last control step if a recording runs or starts now."""
        if self._recorder is None and self._steps % self._every == 0:
            self._first_step = self._steps
            self._recorder = PoseRecorder(self._env, self._length, self._env_ids)
        self._steps += 1
        if self._recorder is not None:
            self._recorder.step()
            if self._steps - self._first_step >= self._length:
                self._finish()

    def render(self) -> None:
        """Do nothing, because `after_step` records the steps."""

    def close(self) -> None:
        """End the current recording, and wait until all videos are written."""
        self._finish()
        self._video_writer.close()

    def _finish(self) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            name = f"{self._prefix}-step-{self._first_step}.mp4"
            self._video_writer.make(self._env, recorder, self._folder / name)
