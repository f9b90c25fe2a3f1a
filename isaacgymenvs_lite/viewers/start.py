"""Checks and starts the viewers (videos, window and page) of a training or of a played policy."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.config.launch import LaunchSettings
from isaacgymenvs_lite.env_interface import StepListener
from isaacgymenvs_lite.rendering.display import check_display
from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.rendering.video import check_encoder
from isaacgymenvs_lite.utils.files import check_no_links
from isaacgymenvs_lite.viewers.videos import VideoCapture, VideoWriter, make_video_folder
from isaacgymenvs_lite.viewers.web_page import WebPage, check_page
from isaacgymenvs_lite.viewers.window import Window

log = logging.getLogger(__name__)


class Viewers:
    """The viewers that the settings choose, for use in a `with` statement.

    Raises:
        RenderingError: this machine cannot draw.
        ConfigError: a package or a display is missing, or another program uses the port.
    """

    def __init__(self, settings: LaunchSettings) -> None:
        self._settings = settings
        self._env: Any = None
        self._listeners: list[StepListener] = []
        if settings.capture_video:
            check_encoder()
            ensure_gl()
        if not settings.headless:
            check_display()
        if settings.viewer == "web":
            check_page(settings.viewer_port)

    def start(
        self, env: Any, run_folder: Path, on_quit: Callable[[], None], prefix: str = "rl-video"
    ) -> None:
        """Start the viewers of a task.

        Args:
            env: the task.
            run_folder: folder whose subfolder `videos/` receives the videos.
            on_quit: function that is called in the task's thread when the window is closed.
            prefix: prefix of the videos' names.

        Raises:
            ConfigError: the folder of videos contains links or cannot be written, or another
                program uses the port.
        """
        settings, folder = self._settings, run_folder / "videos"
        self._env = env
        if settings.capture_video or not settings.headless:
            check_no_links(run_folder, "videos")
        if settings.capture_video:
            on_done = None
            if settings.wandb_activate:
                from isaacgymenvs_lite.run.wandb_observer import log_video as on_done
            make_video_folder(folder)
            log.info("videos go to %s", folder)
            capture = VideoCapture(
                env,
                VideoWriter(on_done),
                folder,
                every=settings.capture_video_freq,
                length=settings.capture_video_len,
                num_envs=settings.capture_video_envs,
                prefix=prefix,
            )
            self._add(capture)
        plays = settings.test
        if not settings.headless:
            every_step = settings.force_render
            self._add(Window(env, folder, on_quit, every_step=every_step, keys_to_task=plays))
        if settings.viewer == "web":
            # A played policy runs in real time, because its episodes are only a few seconds long.
            self._add(WebPage(env, settings.viewer_port, real_time=plays, keys_to_task=plays))
        watched = not settings.headless or settings.viewer == "web"
        if plays and watched and (help_line := getattr(env, "key_help", "")):
            log.info("keys in the viewer: %s", help_line)

    def _add(self, listener: StepListener) -> None:
        self._listeners.append(listener)
        self._env.listeners.append(listener)

    def close(self) -> None:
        """Write the videos, then close the window and the page; a second call does nothing."""
        listeners, self._listeners = self._listeners, []
        for listener in listeners:
            self._env.listeners.remove(listener)
            listener.close()

    def __enter__(self) -> Viewers:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()
