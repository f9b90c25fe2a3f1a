"""Records videos of a task or an environment of Gymnasium at chosen steps or episodes.

    env = gymnasium.make("IsaacGymEnvsLite/Ant-v0", render_mode="rgb_array")
    env = RecordVideo(env, "videos", episode_trigger=lambda episode: episode % 10 == 0)

Gymnasium's recorders need MoviePy, which installs a copy of ffmpeg and an older Pillow.
"""

from __future__ import annotations

import atexit
import inspect
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.error import DependencyNotInstalled
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.rendering.video import check_encoder, save_video
from isaacgymenvs_lite.viewers.videos import VideoWriter, make_video_folder

# Largest number of control steps in a video of a whole episode.
_MAX_LENGTH = 10_000


class TaskVideo:
    """Records videos of environment 0 of a task, and passes all other calls to the task.

    It replaces gym 0.2x's `RecordVideo` in scripts of IsaacGymEnvs. In these scripts a step returns
    four values, but gymnasium's `RecordVideo` expects five values. A thread draws and encodes the
    videos.

    Args:
        env: a task of `isaacgymenvs_lite.make`.
        video_folder: folder for the files, which is made if it does not exist.
        episode_trigger: function of the number of ended episodes of environment 0. If it returns
            True, a video `<name_prefix>-episode-<number>.mp4` starts.
        step_trigger: function of the number of steps. If it returns True, a video
            `<name_prefix>-step-<number>.mp4` starts. Without a trigger the episodes 0, 1, 8, 27,
            ..., 729 and then every thousandth episode are recorded.
        video_length: number of steps in a video; 0 records one episode of environment 0.
        name_prefix: prefix of the files' names; existing files are not overwritten.

    Raises:
        ConfigError: both triggers are given, or the folder cannot be written.
        RenderingError: this machine cannot draw.
    """

    def __init__(
        self,
        env: Any,
        video_folder: str | Path,
        episode_trigger: Callable[[int], bool] | None = None,
        step_trigger: Callable[[int], bool] | None = None,
        video_length: int = 0,
        name_prefix: str = "rl-video",
    ) -> None:
        if episode_trigger is not None and step_trigger is not None:
            raise ConfigError("TaskVideo: expected episode_trigger or step_trigger, got both")
        check_encoder()
        ensure_gl()
        self.env = env
        self.video_folder = Path(video_folder)
        make_video_folder(self.video_folder)
        self.name_prefix = name_prefix
        self.video_length = video_length
        self.step_id = self.episode_id = 0
        self._step_trigger = step_trigger
        self._episode_trigger = episode_trigger or is_cube_or_thousandth
        self._video_writer = VideoWriter()
        self._recorder: PoseRecorder | None = None
        self._path = self.video_folder
        self._recorded = 0
        # A script may exit without closing the task.
        atexit.register(self.close_video_recorder)

    def __getattr__(self, name: str) -> Any:
        # `copy` reads private names and `env` before the constructor has set them.
        if name.startswith("_") or name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def unwrapped(self) -> Any:
        """The task."""
        return getattr(self.env, "unwrapped", self.env)

    def reset(self, **kwargs: Any) -> Any:
        """Reset the task, and start a video if a trigger returns True."""
        observations = self.env.reset(**kwargs)
        self._start_if_due()
        return observations

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Any]]:
        """Advance the task by one control step, and continue, end or start a video."""
        result = self.env.step(actions)
        has_ended = bool(result[2][0])
        self.step_id += 1
        self.episode_id += has_ended
        if self._recorder is not None:
            self._recorder.step()
            self._recorded += 1
            if self._recorded >= self.video_length if self.video_length > 0 else has_ended:
                self._finish()
        self._start_if_due(new_episode=has_ended)
        return result

    def close(self) -> None:
        """Write the started videos, then close the task."""
        atexit.unregister(self.close_video_recorder)
        self.close_video_recorder()
        self.env.close()

    def close_video_recorder(self) -> None:
        """End the current video, and wait until all videos are written."""
        self._finish()
        self._video_writer.close()

    def _start_if_due(self, new_episode: bool = True) -> None:
        if self._recorder is not None:
            return
        if self._step_trigger is not None:
            due, name = self._step_trigger(self.step_id), f"step-{self.step_id}"
        else:
            due = new_episode and self._episode_trigger(self.episode_id)
            name = f"episode-{self.episode_id}"
        if due:
            self._path = self.video_folder / f"{self.name_prefix}-{name}.mp4"
            self._recorder = PoseRecorder(self.unwrapped, self.video_length or _MAX_LENGTH)
            self._recorded = 0

    def _finish(self) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is not None and self._recorded > 0:
            self._video_writer.make(self.unwrapped, recorder, self._path)


class _EncodedByPyAV:
    """Base class that replaces MoviePy by PyAV in Gymnasium's recorders."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        check_encoder()
        given = inspect.signature(super().__init__).bind(*args, **kwargs).arguments
        if given.get("episode_trigger") is None and given.get("step_trigger") is None:
            # Gymnasium's default trigger is in a module that imports MoviePy.
            kwargs["episode_trigger"] = is_cube_or_thousandth
        with suppress(DependencyNotInstalled):  # The last statement of the constructor raises this.
            super().__init__(*args, **kwargs)

    def stop_recording(self: Any) -> None:
        """Write the recorded pictures to a file; write no file if there are no pictures."""
        if self.recorded_frames:
            path = Path(self.video_folder, f"{self._video_name}.mp4")
            save_video(path, self.recorded_frames, self.frames_per_sec)
        self.recorded_frames = []
        self.recording = False
        self._video_name = None


def is_cube_or_thousandth(episode: int) -> bool:
    """Return whether an episode's index is a cube below 1000 or a multiple of 1000."""
    if episode >= 1000:
        return episode % 1000 == 0
    return round(episode ** (1 / 3)) ** 3 == episode


class RecordVideo(_EncodedByPyAV, gymnasium.wrappers.RecordVideo):
    """`gymnasium.wrappers.RecordVideo` without MoviePy, with the same arguments."""


class RecordVectorVideo(_EncodedByPyAV, gymnasium.wrappers.vector.RecordVideo):
    """`gymnasium.wrappers.vector.RecordVideo`, which shows all environments, without MoviePy."""
