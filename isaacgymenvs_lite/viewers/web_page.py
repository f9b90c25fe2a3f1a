"""A task in a browser: MuJoCo's web viewer, served on one port during a training or a play.

A process of its own serves the page, and browsers draw it; the task sends a state up to 30 times a
second and never waits. The page is at localhost by default; elsewhere its address has a secret
token.
"""

from __future__ import annotations

import copy
import importlib.util
import logging
import os
import socket
import sys
import time
from collections.abc import Sequence
from typing import Any

import mujoco

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.terrain_window import TerrainWindow
from isaacgymenvs_lite.rendering.tracks import PoseReader, markers_of
from isaacgymenvs_lite.viewers.reference_overlay import ReferenceOverlay
from isaacgymenvs_lite.viewers.task_keys import TaskKeys
from isaacgymenvs_lite.viewers.web_process import PageProcess, missing_viewer, no_listening

log = logging.getLogger(__name__)

# Limit of the states that are sent to the page.
_PICTURES_PER_S = 30.0


class WebPage:
    """Shows environment 0 of a task in browsers; a `StepListener`.

    If the page's process ends, the task goes on without it.

    Args:
        env: the task; the reference of one that imitates is shown beside the character.
        host: name or address to listen at.
        port: 0 takes a free one.
        real_time: let the task wait, so that it is no faster than the simulated time.
        allowed_hosts: more hosts, with or without a port, at which browsers may reach the page.
        keys_to_task: whether keys that are pressed in the page reach the task's `on_key`.

    Attributes:
        url: address of the page, with its token if other machines reach it.
        process: serves the page.

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
        keys_to_task: bool = True,
    ) -> None:
        check_page(host, port, allowed_hosts)
        self._keys = TaskKeys(env, keys_to_task)
        self._read_pose = PoseReader(env)
        # As in videos, rough ground is drawn around the robot only.
        self._model: mujoco.MjModel = copy.copy(env.simulation.model)
        self._ground = TerrainWindow(self._model)
        self._ground.move(self._read_pose(0)[:2])
        self._has_new_ground = False
        self._reference = ReferenceOverlay.for_task(env, self._model)
        self._markers_of = markers_of(env)
        self._pace_s = env.simulation.dt if real_time else 0.0
        self._next_step_s = self._next_picture_s = time.monotonic()
        self.process = PageProcess(self._model, host, port, allowed_hosts)
        self._is_open = True
        name = socket.gethostname() if host == "0.0.0.0" else host
        self.url = f"http://{name}:{self.process.port}/"
        who = "every user of this machine can"
        if self.process.token:
            self.url += f"?token={self.process.token}"
            who = "whoever has this address can; it is not encrypted"
        self.render()
        log.info("watch it at %s (%s)", self.url, who)

    @property
    def keeps_playing(self) -> bool:
        """Whether the page is served: browsers may come and go."""
        return self._is_open and self.process.is_running()

    def after_step(self) -> None:
        """Pass on keys, and show the new state if the last one was long enough ago."""
        for key in self.process.link.pressed_keys():
            self._keys.press(key)
        now = time.monotonic()
        if now >= self._next_picture_s:
            self._next_picture_s = now + 1.0 / _PICTURES_PER_S
            self.render()
        if self._pace_s:
            time.sleep(max(0.0, self._next_step_s - now))
            self._next_step_s = max(self._next_step_s, now) + self._pace_s

    def render(self) -> None:
        """Show the current state, unless the page is busy with those before."""
        if not self._is_open:
            return
        if not self.process.is_running():
            how = self.process.how_it_ended()
            log.warning("viewer=web: the page ended (%s); the run goes on without it", how)
            self.close()
            return
        qpos = self._read_pose(0)
        self._has_new_ground |= self._ground.move(qpos[:2])
        if self._has_new_ground:
            self._has_new_ground = not self.process.link.send_model(self._model)
        reference = None if self._reference is None else self._reference.pose(qpos)
        self.process.link.send_state(qpos, reference, self._markers_of(0))

    def close(self) -> None:
        """End the page; a second call does nothing."""
        self._is_open = False
        self.process.close()


def check_page(host: str, port: int, allowed_hosts: Sequence[str] = ()) -> None:
    """Check that a page can be served.

    Raises:
        ConfigError: the port is taken, the host is not an address of this machine, an allowed host
            is misspelt, the viewer is not installed, or this is not Linux.
    """
    try:
        is_installed = importlib.util.find_spec("mujoco.studio.web_viewer") is not None
        from isaacgymenvs_lite.viewers.web_guard import address_of, read_hosts  # imports websockets
    except ImportError as error:
        raise ConfigError(missing_viewer(error)) from error
    if not is_installed:
        raise ConfigError(missing_viewer("it is not installed"))
    if not hasattr(os, "memfd_create"):  # see web_link
        raise ConfigError(
            f"viewer=web runs on Linux only so far, not on {sys.platform}; capture_video=True makes"
            " videos, headless=False opens a window"
        )
    read_hosts(allowed_hosts)
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((address_of(host), port))
            trial.listen()
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else None
            raise ConfigError(no_listening(host, port, reason or error)) from error
