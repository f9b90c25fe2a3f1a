"""Draws and encodes videos in a thread, so that the recorded task does not wait."""

from __future__ import annotations

import logging
import math
import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.rendering.markers import Marker
from isaacgymenvs_lite.rendering.tracks import PoseRecorder, Track
from isaacgymenvs_lite.rendering.video import draw_tracks, save_video
from isaacgymenvs_lite.rendering.view import View

log = logging.getLogger(__name__)

SINGLE_SIZE, TILE_SIZE = (640, 480), (320, 240)
"""Pixels of a picture of one environment, and of each of several."""
# Jobs that may wait, because their poses are in memory.
_MAX_WAITING = 8


@dataclass(frozen=True)
class VideoJob:
    """The content of a video.

    Attributes:
        path: the file, .mp4; if it exists already, the new one gets a number behind its name.
        model: of the robots.
        dt_s: from one picture to the next.
        tracks: (T, nq) each.
        markers: to draw, for each time, for each track.
        follow: whether the camera follows the robot.
    """

    path: Path
    model: mujoco.MjModel
    dt_s: float
    tracks: Sequence[Track]
    markers: Sequence[Sequence[Sequence[Marker]]]
    follow: bool = True

    @classmethod
    def from_recording(cls, env: Any, recorder: PoseRecorder, path: Path) -> VideoJob:
        """Return the job for a recording; `task.env.cameraFollow: False` fixes the camera."""
        simulation = env.simulation
        follow = bool(env.cfg["env"].get("cameraFollow", True))
        tracks, markers = recorder.tracks(), recorder.markers()
        return cls(path, simulation.model, simulation.dt, tracks, markers, follow)


class VideoWriter:
    """Writes videos one after the other, in a thread that starts with the first.

    A video that cannot be written is reported in the log, so that a training goes on.

    Args:
        on_done: called in the thread with the path of each video.
    """

    def __init__(self, on_done: Callable[[Path], None] | None = None) -> None:
        self._on_done = on_done
        self._waiting: queue.Queue[VideoJob | None] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._left_out = 0

    def make(self, job: VideoJob) -> None:
        """Queue a job; it is left out if too many wait already."""
        if self._waiting.qsize() >= _MAX_WAITING:
            self._left_out += 1
            if self._left_out == 1:
                log.warning(
                    "videos are recorded faster than they are drawn: leaving out %s and maybe"
                    " others; raise capture_video_freq or lower capture_video_len",
                    job.path.name,
                )
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="videos", daemon=True)
            self._thread.start()
        self._waiting.put(job)

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
    """Draw and encode a job; return its path.

    Raises:
        RenderingError: this machine cannot draw.
        ConfigError: the file cannot be written.
    """
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
    return save_video(_unused(job.path), images, 1.0 / job.dt_s)


def _unused(path: Path) -> Path:
    """Return `path`, with a number behind its name if there is such a file."""
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_stem(f"{path.stem}-{number}")
    return free
