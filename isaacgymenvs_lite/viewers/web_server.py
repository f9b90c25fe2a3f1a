"""MuJoCo's web viewer in a thread: where it listens, what it shows beside the model, what it says.

Imports all of `mujoco.studio`: import it where it is needed.
"""

from __future__ import annotations

import contextlib
import gc
import io
import logging
import socket
import threading
from dataclasses import dataclass
from typing import Any

import mujoco
from mujoco.studio import launch_thread, messages, plugin, viewer_protocol, web_viewer

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.view import aim_camera

_START_TIMEOUT_S = 20.0
# The number in a model that is the page's sky.
_SKY_COLOUR = "filament.clear_color"


class OverlayPlugin(plugin.ViewerPlugin):
    """Shows geoms beside the model, and lets the camera go along with the robot.

    Attributes:
        geoms: what to show; replace the list, do not change it.
    """

    def __init__(self) -> None:
        self.geoms: list[mujoco.MjvGeom] = []

    @messages.handler
    def on_init(self, event: viewer_protocol.ViewerInitEvent) -> None:
        """Let the camera follow a robot that moves about, and colours be those of videos."""
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
        """Take what is to be shown into the next picture."""
        del event
        self.viewer.extra_geoms[:] = self.geoms


class QuietViewer(web_viewer.WebViewer):
    """Listens at one address, rather than at all of them, and prints nothing.

    Attributes:
        address: where; set it before an instance is made.
    """

    address = "127.0.0.1"

    @property
    def _host(self) -> str:
        return self.address

    @_host.setter
    def _host(self, value: str) -> None:
        del value  # MuJoCo's own choice: every address of the machine

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_post_model(self, event: messages.PostModelEvent) -> None:
        del event
        self._update_model()


@dataclass(frozen=True)
class Page:
    """A running server.

    Attributes:
        handle: takes states.
        overlay: what is shown beside the model.
        port: where browsers connect.
    """

    handle: Any
    overlay: OverlayPlugin
    port: int


def start_server(model: mujoco.MjModel, address: str, port: int) -> Page:
    """Start the viewer in a thread, and return when browsers can connect.

    Args:
        model: what is shown.
        address: of this machine, where to listen.
        port: 0 takes a free one.

    Raises:
        ConfigError: it does not start.
    """
    _let_the_log_decide()
    overlay, started, ports = OverlayPlugin(), threading.Event(), []
    config = viewer_protocol.ViewerConfig(
        title="isaacgymenvs_lite", gfx="web", http_port=port or _free_port(address)
    )

    def serve(endpoint: Any) -> None:
        try:
            viewer_class = type("Viewer", (QuietViewer,), {"address": address})
            viewer = viewer_class(config, endpoint, model=model, plugins=[overlay])
            ports.append(config.http_port)
        finally:
            started.set()
        viewer_protocol.run_viewer_loop(viewer)

    # Python collects garbage in whichever thread asks for memory. The viewer's thread, freeing what
    # others had made, was seen to hang and then to crash, in a process with millions of objects: it
    # gets to see only what is made from now on.
    gc.collect()
    gc.freeze()
    with contextlib.redirect_stdout(io.StringIO()):  # a banner
        handle = launch_thread.launch_thread(serve)
        started.wait(_START_TIMEOUT_S)
    if not ports:
        gc.unfreeze()
        raise ConfigError(f"viewer=web: it did not start within {_START_TIMEOUT_S:.0f} s")
    return Page(handle, overlay, ports[0])


def _let_the_log_decide() -> None:
    """Take the server's lines about connections from standard output."""
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
