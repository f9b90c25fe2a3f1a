"""Videos of a training or a play: every so many steps the next ones are recorded, then drawn.

Recording copies the state of the environments that are shown, some dozens of numbers. Drawing and
encoding, which take a hundred times as long, are left to a thread (`FilmMaker`).
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.watching.film_maker import Film, FilmMaker

log = logging.getLogger(__name__)


class VideoCapture:
    """Records a task again and again; a `Watcher`.

    Args:
        env: the task.
        film_maker: draws what was recorded.
        folder: where the files go; it exists.
        every: control steps from the start of one recording to that of the next.
        length: control steps of a recording.
        num_envs: the first so many environments are shown, in tiles.
        prefix: the files are called `<prefix>-step-<steps made before>.mp4`.
    """

    def __init__(
        self,
        env: Any,
        film_maker: FilmMaker,
        folder: Path,
        *,
        every: int,
        length: int,
        num_envs: int = 1,
        prefix: str = "rl-video",
    ) -> None:
        self._env = env
        self._film_maker = film_maker
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
        """Do nothing: what is recorded does not depend on what is shown."""

    def close(self) -> None:
        """Let a recording that was begun end here, and wait for what is still drawn."""
        self._finish()
        self._film_maker.close()

    def _finish(self) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            name = f"{self._prefix}-step-{self._first_step}.mp4"
            self._film_maker.make(Film.of_recording(self._env, recorder, self._folder / name))
