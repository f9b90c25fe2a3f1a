"""Shows a task in a browser by MuJoCo's web viewer, on a port of localhost.

The viewer has native code and threads. Therefore it runs in a separate process (`web_server`), so
that its crash does not end a training. The task sends its state up to 30 times a second and never
waits for the viewer.
"""

from __future__ import annotations

import copy
import importlib.util
import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import isaacgymenvs_lite
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.scene import TerrainWindow
from isaacgymenvs_lite.rendering.tracks import PoseReader, markers_of
from isaacgymenvs_lite.viewers.reference_overlay import ReferenceOverlay
from isaacgymenvs_lite.viewers.window import press_key

log = logging.getLogger(__name__)

# Largest number of states that the page receives per second.
_PICTURES_PER_S = 30.0
_CLOSE_TIMEOUT_S = 3.0
_MAX_KEY_BYTES = 16
_MAX_KEYS = 64
_PROGRAM = "from isaacgymenvs_lite.viewers.web_server import main; main()"


class WebPage:
    """Shows environment 0 of a task in browsers; a `StepListener`.

    If the page's process ends, the task continues without the page.

    Args:
        env: the task; the page also shows the reference of an imitation task.
        port: port number; 0 means any free port.
        real_time: whether the task waits after each step, so that it runs at most in real time.
        keys_to_task: whether the task's `on_key` receives the keys that are pressed on the page.

    Raises:
        ConfigError: another program uses the port, or the viewer is not installed.
    """

    def __init__(self, env: Any, port: int, *, real_time: bool, keys_to_task: bool = True) -> None:
        check_page(port)
        self._env, self._keys_to_task = env, keys_to_task
        self._read_pose = PoseReader(env)
        # Only the piece of rough ground around the robot is drawn, as in videos.
        self._model: mujoco.MjModel = copy.copy(env.simulation.model)
        self._ground = TerrainWindow(self._model)
        self._ground.move(self._read_pose(0)[:2])
        self._has_new_model = True
        self._reference = ReferenceOverlay.for_task(env, self._model)
        self._markers_of = markers_of(env)
        self._pace_s = env.simulation.dt if real_time else 0.0
        self._next_step_s = self._next_picture_s = time.monotonic()
        # The socket sends a packet completely or not at all; each message is one packet.
        self._link, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._link.setblocking(False)
        with there, _listen(port) as listener:
            self.url = f"http://localhost:{listener.getsockname()[1]}/"
            self.process = _start(there, listener)
        self._is_open = True
        self.render()
        log.info("watch it at %s (every user of this machine can)", self.url)

    @property
    def keeps_playing(self) -> bool:
        """Whether the page's process runs, with or without connected browsers."""
        return self._is_open and self.process.poll() is None

    def after_step(self) -> None:
        """Pass keys to the task, and send the new state unless one was sent just before."""
        self._read_keys()
        now = time.monotonic()
        if now >= self._next_picture_s:
            self._next_picture_s = now + 1.0 / _PICTURES_PER_S
            self.render()
        if self._pace_s:
            time.sleep(max(0.0, self._next_step_s - now))
            self._next_step_s = max(self._next_step_s, now) + self._pace_s

    def _read_keys(self) -> None:
        for _ in range(_MAX_KEYS):
            try:
                packet = self._link.recv(_MAX_KEY_BYTES)
            except OSError:  # No key has arrived, or the page's process has closed the socket.
                return
            if not packet:
                return
            if self._keys_to_task:
                press_key(self._env, packet.decode("ascii", "replace"))

    def render(self) -> None:
        """Send the current state, unless earlier states still wait in the socket."""
        if not self._is_open:
            return
        status = self.process.poll()
        if status is not None:
            how = f"exit status {status}" if status >= 0 else signal.strsignal(-status)
            log.warning("viewer=web: the page ended (%s); the run goes on without it", how)
            self.close()
            return
        qpos = self._read_pose(0)
        self._has_new_model |= self._ground.move(qpos[:2])
        if self._has_new_model:
            self._has_new_model = not self._send_model()
        reference = None if self._reference is None else self._reference.pose(qpos)
        self._send(pickle.dumps((qpos, reference, self._markers_of(0))))

    def _send_model(self) -> bool:
        content = np.empty(mujoco.mj_sizeModel(self._model), np.uint8)
        mujoco.mj_saveModel(self._model, None, content)
        with os.fdopen(os.memfd_create("model.mjb"), "wb") as file:
            file.write(content.data)
            file.flush()
            return self._send(b"model", file.fileno())

    def _send(self, packet: bytes, *files: int) -> bool:
        """Send a packet; return whether the socket accepted it."""
        try:
            socket.send_fds(self._link, [packet], files)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """End the page's process; a second call does nothing."""
        self._is_open = False
        self._link.close()
        try:
            self.process.wait(_CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def check_page(port: int) -> None:
    """Check that the page can be served.

    Raises:
        ConfigError: another program uses the port, or the viewer is not installed.
    """
    if sys.platform != "linux":
        raise ConfigError(
            f"viewer=web runs on Linux only so far, not on {sys.platform}; capture_video=True makes"
            " videos, headless=False opens a window"
        )
    try:
        import websockets  # noqa: F401

        found = importlib.util.find_spec("mujoco.studio.web_viewer")
    except ImportError:
        found = None
    if found is None:
        raise ConfigError("viewer=web needs MuJoCo's web viewer; pip install mujoco-studio")
    _listen(port).close()


def _listen(port: int) -> socket.socket:
    """Return a socket that listens on localhost."""
    try:
        return socket.create_server(("127.0.0.1", port))
    except OSError as error:
        raise ConfigError(
            f"viewer_port={port}: cannot listen there ({error.strerror}); choose another port, 0"
            " takes a free one"
        ) from error


def _start(link: socket.socket, listener: socket.socket) -> subprocess.Popen[bytes]:
    """Start the process that serves the page and inherits both sockets."""
    files = (link.fileno(), listener.fileno())
    # The new process has the import path of this process.
    folders = [str(Path(isaacgymenvs_lite.__file__).parents[1])]
    folders += [os.path.abspath(folder) for folder in sys.path if folder]
    arguments = map(str, (os.getpid(), *files))
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _PROGRAM, *arguments],
        pass_fds=files,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        process_group=0,  # Ctrl-C in a terminal must reach only the task, which closes the page.
    )
