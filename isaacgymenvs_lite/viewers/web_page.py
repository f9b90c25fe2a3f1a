"""A task in a browser: MuJoCo's own web viewer, served on one port while something else goes on.

The viewer runs in a thread of its own and draws in the browser; the training hands it a state now
and then. It has no password: whoever reaches the port can look on, hence localhost by default.
"""

from __future__ import annotations

import atexit
import contextlib
import copy
import gc
import importlib
import io
import logging
import socket
import time
from typing import Any

import mujoco

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.terrain_window import TerrainWindow
from isaacgymenvs_lite.rendering.tracks import PoseReader
from isaacgymenvs_lite.viewers.reference_overlay import ReferenceOverlay, RobotOverlay

log = logging.getLogger(__name__)

# A browser is told of a new state at most so often.
_PICTURES_PER_S = 30.0
_ADDRESSES = {"localhost": "127.0.0.1"}
_MAX_GEOMS = 200


class WebPage:
    """Shows environment 0 of a task in browsers; a `StepListener`.

    Args:
        env: the task; the reference of one that imitates is shown beside the character.
        host: name or address to listen at.
        port: 0 takes a free one.
        real_time: let the task wait so that it is no faster than what it simulates.

    Attributes:
        url: where to look.

    Raises:
        ConfigError: the port is taken, or the viewer is not installed.
    """

    def __init__(self, env: Any, host: str, port: int, *, real_time: bool) -> None:
        check_page(host, port)
        self._env = env
        self._read_pose = PoseReader(env)
        # Of rough ground a browser gets the piece about the robot, too.
        self._whole: mujoco.MjModel = copy.copy(env.simulation.model)
        self._ground = TerrainWindow(self._whole)
        self._ground.move(self._read_pose(0)[:2])
        self._model = copy.copy(self._whole)
        self._data = mujoco.MjData(self._model)
        self._ghost = ReferenceOverlay(env) if hasattr(env, "motion_lib") else None
        self._painter = RobotOverlay(self._model)
        self._scene = mujoco.MjvScene(self._model, _MAX_GEOMS)
        self._pace_s = env.simulation.dt if real_time else 0.0
        self._next_step_s = self._next_picture_s = time.monotonic()
        from isaacgymenvs_lite.viewers.web_server import start_server  # imports all of the viewer

        self._page = start_server(self._model, _ADDRESSES.get(host, host), port)
        self.url = f"http://{host}:{self._page.port}/"
        atexit.register(self.close)  # a thread that goes on when Python ends takes it down
        self.render()
        log.info("watch it at %s (no password: who reaches the port can look on)", self.url)

    @property
    def keeps_playing(self) -> bool:
        """Whether the server runs: browsers may come and go."""
        return self._page.handle.is_running()

    def after_step(self) -> None:
        """Show the new state if the last one was long enough ago."""
        now = time.monotonic()
        if now >= self._next_picture_s:
            self._next_picture_s = now + 1.0 / _PICTURES_PER_S
            self.render()
        if self._pace_s:
            time.sleep(max(0.0, self._next_step_s - now))
            self._next_step_s = max(self._next_step_s, now) + self._pace_s

    def render(self) -> None:
        """Show the present state."""
        if not self._page.handle.is_running():
            return
        qpos = self._read_pose(0)
        self._data.qpos[:] = qpos
        if self._ground.move(qpos[:2]):
            self._model = copy.copy(self._whole)  # another model: browsers fetch it
        if self._ghost is not None:
            self._scene.ngeom = 0
            self._painter.add_to(self._scene, self._ghost.pose(qpos))
            self._page.overlay.geoms = list(self._scene.geoms[: self._scene.ngeom])
        self._page.handle.sync(self._model, self._data)

    def close(self) -> None:
        """End the server; a second call does nothing."""
        atexit.unregister(self.close)
        with contextlib.redirect_stdout(io.StringIO()):
            self._page.handle.close()
        gc.unfreeze()  # see start_server


def check_page(host: str, port: int) -> None:
    """Say at once that a page cannot be served.

    Raises:
        ConfigError: the port is taken, the host is not this machine's, or the viewer is missing.
    """
    try:
        importlib.import_module("mujoco.studio.web_viewer")
    except ImportError as error:
        raise ConfigError(
            f"viewer=web needs MuJoCo's web viewer, which cannot be imported ({error}); pip install"
            " mujoco-studio"
        ) from error
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((_ADDRESSES.get(host, host), port))
            trial.listen()
        except OSError as error:
            raise ConfigError(
                f"viewer_port={port}: cannot listen at {host}:{port} ({error.strerror or error});"
                " choose another port, 0 takes a free one"
            ) from error
