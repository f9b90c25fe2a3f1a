"""MuJoCo's web viewer in a thread, guarded, with additional geoms, and without prints.

It imports all of `mujoco.studio`, so import it where it is needed.
"""

from __future__ import annotations

import contextlib
import gc
import io
import logging
import socket
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
from mujoco.studio import launch_thread, messages, plugin, viewer_protocol, web_viewer
from mujoco.studio.web import web_server

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.view import aim_camera
from isaacgymenvs_lite.viewers.web_guard import PageGuard, address_of

_START_TIMEOUT_S = 20.0
# Custom number of a model with the colour of the page's sky.
_SKY_COLOUR = "filament.clear_color"
_GUARDING = threading.Lock()


class OverlayPlugin(plugin.ViewerPlugin):
    """Adds geoms to the model's picture, and lets the camera follow the robot.

    Attributes:
        geoms: to add; replace the list, do not change it.
    """

    def __init__(self) -> None:
        self.geoms: list[mujoco.MjvGeom] = []

    @messages.handler
    def on_init(self, event: viewer_protocol.ViewerInitEvent) -> None:
        """Let the camera follow a robot that moves about, and use the colours of videos."""
        viewer = event.viewer
        aim_camera(viewer.camera, viewer.model)
        flags = list(viewer.render_flags.flags)
        # The floor would mirror the sky so strongly that it looks white.
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        if mujoco.mj_name2id(viewer.model, mujoco.mjtObj.mjOBJ_NUMERIC, _SKY_COLOUR) >= 0:
            flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0  # dark grey, whatever its texture
        viewer.render_flags.flags = flags

    @messages.handler
    def on_update(self, event: messages.UpdateEvent) -> None:
        """Add the geoms to the next picture."""
        self.viewer.extra_geoms[:] = self.geoms


class QuietViewer(web_viewer.WebViewer):
    """Listens at one address in place of all of them, and prints nothing.

    Attributes:
        address: where to listen; set it before an instance is made.
    """

    address = "127.0.0.1"

    @property
    def _host(self) -> str:
        return self.address

    @_host.setter
    def _host(self, value: str) -> None:
        """Ignore MuJoCo's choice, every address of the machine."""

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_post_model(self, event: messages.PostModelEvent) -> None:
        self._update_model()


@dataclass(frozen=True)
class WebServer:
    """A running server.

    Attributes:
        handle: receives states.
        overlay: the additional geoms.
        port: where browsers connect.
        token: secret that browsers need; '' if only this machine reaches the page.
    """

    handle: Any
    overlay: OverlayPlugin
    port: int
    token: str


def start_server(
    model: mujoco.MjModel, host: str, port: int, allowed_hosts: Iterable[str]
) -> WebServer:
    """Start the viewer in a thread, and return when browsers can connect.

    Args:
        model: what is shown.
        host: name or address of this machine, where to listen.
        port: 0 takes a free one.
        allowed_hosts: see `PageGuard`.

    Raises:
        ConfigError: it does not start, or an allowed host is not one.
    """
    _silence_server_log()
    address = address_of(host)
    overlay, started = OverlayPlugin(), threading.Event()
    port = port or _free_port(address)
    config = viewer_protocol.ViewerConfig(title="isaacgymenvs_lite", gfx="web", http_port=port)
    guard = PageGuard(host, address, port, allowed_hosts)

    def serve(endpoint: Any) -> None:
        viewer_class = type("Viewer", (QuietViewer,), {"address": address})
        try:
            with _served_by(guard):
                viewer = viewer_class(config, endpoint, model=model, plugins=[overlay])
        finally:
            started.set()
        if guard.started.is_set():
            viewer_protocol.run_viewer_loop(viewer)
        else:
            viewer.close()

    # Python collects garbage in the thread that happens to allocate. In a process with millions of
    # objects the viewer's thread hung and crashed while it freed objects of other threads. After
    # `freeze` it frees only objects that are made from now on.
    gc.collect()
    gc.freeze()
    with contextlib.redirect_stdout(io.StringIO()):  # a banner
        handle = launch_thread.launch_thread(serve)
        started.wait(_START_TIMEOUT_S)
    if not guard.started.is_set():
        gc.unfreeze()
        raise ConfigError(f"viewer=web: it did not start within {_START_TIMEOUT_S:.0f} s")
    return WebServer(handle, overlay, port, guard.token)


@contextlib.contextmanager
def _served_by(guard: PageGuard) -> Iterator[None]:
    """Let the server of MuJoCo's that starts meanwhile run behind the guard.

    It has no parameter for limits, so its name of `websockets.serve` is replaced until its thread
    has called that. A version that no longer calls it is not served at all.
    """
    with _GUARDING:
        original = web_server.serve
        web_server.serve = guard.serve
        try:
            yield
            guard.started.wait(_START_TIMEOUT_S / 2)
        finally:
            web_server.serve = original


def _silence_server_log() -> None:
    """Keep the server's lines about connections off standard output."""
    server_log = logging.getLogger("WebServer")
    server_log.handlers.clear()
    server_log.propagate = True
    server_log.setLevel(logging.WARNING)
    # A browser that leaves while it is sent a state is no error.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)


def _free_port(address: str) -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as trial:
        trial.bind((address, 0))
        return int(trial.getsockname()[1])
