"""Gymnasium's `RecordVideo`, encoded by PyAV as all videos of this project.

    env = gymnasium.make("IsaacGymEnvsLite/Ant-v0", render_mode="rgb_array")
    env = RecordVideo(env, "videos", episode_trigger=lambda episode: episode % 10 == 0)

Gymnasium's own classes encode with MoviePy, which installs an ffmpeg and an older Pillow.
"""

from __future__ import annotations

import inspect
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.error import DependencyNotInstalled

from isaacgymenvs_lite.rendering.video import check_encoder, save_video


class _EncodedByPyAV:
    """Replaces the start and the end of a recording in Gymnasium's classes."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        check_encoder()
        given = inspect.signature(super().__init__).bind(*args, **kwargs).arguments
        if given.get("episode_trigger") is None and given.get("step_trigger") is None:
            # Gymnasium's own is in a module that imports MoviePy.
            kwargs["episode_trigger"] = is_cube_or_thousandth
        with suppress(DependencyNotInstalled):  # raised at the end, when all else is done
            super().__init__(*args, **kwargs)

    def stop_recording(self: Any) -> None:
        """Write the recorded pictures; without any there is no file.

        Raises:
            ConfigError: the folder cannot be written.
        """
        if self.recorded_frames:
            path = Path(self.video_folder, f"{self._video_name}.mp4")
            save_video(path, self.recorded_frames, self.frames_per_sec)
        self.recorded_frames = []
        self.recording = False
        self._video_name = None


def is_cube_or_thousandth(episode: int) -> bool:
    """Whether an episode is recorded by default: 0, 1, 8, ..., 729, and each 1000th."""
    if episode >= 1000:
        return episode % 1000 == 0
    return round(episode ** (1 / 3)) ** 3 == episode


class RecordVideo(_EncodedByPyAV, gymnasium.wrappers.RecordVideo):
    """`gymnasium.wrappers.RecordVideo` without MoviePy, of the same arguments.

    Raises:
        MissingPackageError: PyAV is not installed.
    """


class RecordVectorVideo(_EncodedByPyAV, gymnasium.wrappers.vector.RecordVideo):
    """`gymnasium.wrappers.vector.RecordVideo` without MoviePy: all environments in one picture.

    Raises:
        MissingPackageError: PyAV is not installed.
    """
