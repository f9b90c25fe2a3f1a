"""What the command line asks for to be watched: checked before anything starts, then begun."""

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
from isaacgymenvs_lite.viewers.video_capture import capture_videos
from isaacgymenvs_lite.viewers.web_page import WebPage, check_page
from isaacgymenvs_lite.viewers.window import Window

log = logging.getLogger(__name__)


class Viewers:
    """The listeners of a session. Use it in a `with` statement, or call `close`.

    Args:
        settings: of the launch.

    Raises:
        RenderingError: this machine cannot draw what is asked for.
        ConfigError: a package that is needed is missing, there is no display, a port is taken.
    """

    def __init__(self, settings: LaunchSettings) -> None:
        self._settings = settings
        self._env: Any = None
        self._watchers: list[StepListener] = []
        if settings.capture_video:
            check_encoder()
            ensure_gl()
        if not settings.headless:
            check_display()
        if settings.viewer == "web":
            check_page(settings.viewer_host, settings.viewer_port)

    def start(
        self, env: Any, run_folder: Path, on_quit: Callable[[], None], prefix: str = "rl-video"
    ) -> None:
        """Begin to watch a task.

        Args:
            env: the task.
            run_folder: videos go to the folder `videos/` in it.
            on_quit: called in the task's thread when somebody closes the window.
            prefix: of the names of videos.

        Raises:
            ConfigError: the folder of videos cannot be written, or a port was taken meanwhile.
        """
        settings, folder = self._settings, run_folder / "videos"
        self._env = env
        if settings.capture_video:
            self._watchers.append(self._capture(env, folder, prefix))
        if not settings.headless:
            self._add(Window(env, folder, on_quit, every_step=settings.force_render))
        if settings.viewer == "web":
            # A training on a server is not held up; a play would be over before one could look.
            page = WebPage(env, settings.viewer_host, settings.viewer_port, real_time=settings.test)
            self._add(page)

    def _add(self, watcher: StepListener) -> None:
        self._watchers.append(watcher)
        self._env.listeners.append(watcher)

    def _capture(self, env: Any, folder: Path, prefix: str) -> StepListener:
        settings = self._settings
        on_done = None
        if settings.wandb_activate:
            from isaacgymenvs_lite.run.wandb_observer import log_video

            on_done = log_video
        return capture_videos(
            env,
            folder,
            every=settings.capture_video_freq,
            length=settings.capture_video_len,
            num_envs=settings.capture_video_envs,
            prefix=prefix,
            on_done=on_done,
        )

    def close(self) -> None:
        """Finish what is being recorded and close what is open; a second call does nothing."""
        listeners, self._watchers = self._watchers, []
        for watcher in listeners:
            self._env.listeners.remove(watcher)
            watcher.close()

    def __enter__(self) -> Viewers:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()
