"""A task in a browser: MuJoCo's web viewer, served on one port during a training or a play.

The viewer runs in its own thread and draws in the browser; it receives a state up to 30 times a
second. It listens at localhost by default; elsewhere its address has a secret token.
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
from collections.abc import Sequence
from typing import Any

import mujoco

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.terrain_window import TerrainWindow
from isaacgymenvs_lite.rendering.tracks import PoseReader
from isaacgymenvs_lite.viewers.reference_overlay import ReferenceOverlay

log = logging.getLogger(__name__)

# Limit of the states that are sent to browsers.
_PICTURES_PER_S = 30.0
_MAX_GEOMS = 200


class WebPage:
    """Shows environment 0 of a task in browsers; a `StepListener`.

    Args:
        env: the task; the reference of one that imitates is shown beside the character.
        host: name or address to listen at.
        port: 0 takes a free one.
        real_time: let the task wait, so that it is no faster than the simulated time.
        allowed_hosts: more hosts, with or without a port, at which browsers may reach the page.

    Attributes:
        url: address of the page, with its token if other machines reach it.
        server: the running server.

    Raises:
        ConfigError: the port is taken, the viewer is not installed, or a host is misspelt.
    """

    def __init__(
        self,
        env: Any,
        host: str,
        port: int,
        *,
        real_time: bool,
        allowed_hosts: Sequence[str] = (),
    ) -> None:
        check_page(host, port, allowed_hosts)
        self._env = env
        self._read_pose = PoseReader(env)
        # As in videos, rough ground is drawn around the robot only.
        self._whole: mujoco.MjModel = copy.copy(env.simulation.model)
        self._ground = TerrainWindow(self._whole)
        self._ground.move(self._read_pose(0)[:2])
        self._model = copy.copy(self._whole)
        self._data = mujoco.MjData(self._model)
        self._reference = ReferenceOverlay.for_task(env, self._model)
        self._scene = mujoco.MjvScene(self._model, _MAX_GEOMS)
        self._pace_s = env.simulation.dt if real_time else 0.0
        self._next_step_s = self._next_picture_s = time.monotonic()
        from isaacgymenvs_lite.viewers.web_server import start_server  # imports all of the viewer

        self.server = start_server(self._model, host, port, allowed_hosts)
        name = socket.gethostname() if host == "0.0.0.0" else host
        self.url = f"http://{name}:{self.server.port}/"
        who = "every user of this machine can"
        if self.server.token:
            self.url += f"?token={self.server.token}"
            who = "whoever has this address can; it is not encrypted"
        atexit.register(self.close)  # a thread that still runs when Python ends crashes it
        self.render()
        log.info("watch it at %s (%s)", self.url, who)

    @property
    def keeps_playing(self) -> bool:
        """Whether the server runs: browsers may come and go."""
        return self.server.handle.is_running()

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
        """Show the current state."""
        if not self.server.handle.is_running():
            return
        qpos = self._read_pose(0)
        self._data.qpos[:] = qpos
        if self._ground.move(qpos[:2]):
            self._model = copy.copy(self._whole)  # a new object, so that browsers fetch it
        if self._reference is not None:
            self._scene.ngeom = 0
            self._reference.add_to(self._scene, qpos)
            self.server.overlay.geoms = list(self._scene.geoms[: self._scene.ngeom])
        self.server.handle.sync(self._model, self._data)

    def close(self) -> None:
        """End the server; a second call does nothing."""
        atexit.unregister(self.close)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.handle.close()
        # A viewer that is freed while the next page runs destroys that page's native state.
        self.server.overlay.viewer = None
        gc.unfreeze()  # see start_server


def check_page(host: str, port: int, allowed_hosts: Sequence[str] = ()) -> None:
    """Check that a page can be served.

    Raises:
        ConfigError: the port is taken, the host is not an address of this machine, an allowed host
            is misspelt, or the viewer is not installed.
    """
    try:
        importlib.import_module("mujoco.studio.web_viewer")
    except ImportError as error:
        raise ConfigError(
            f"viewer=web needs MuJoCo's web viewer, which cannot be imported ({error}); pip install"
            " mujoco-studio"
        ) from error
    from isaacgymenvs_lite.viewers.web_guard import address_of, read_hosts  # imports websockets

    read_hosts(allowed_hosts)
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((address_of(host), port))
            trial.listen()
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else None
            raise ConfigError(
                f"viewer_port={port}: cannot listen at {host[:80]}:{port} ({reason or error});"
                " choose another port, 0 takes a free one"
            ) from error
