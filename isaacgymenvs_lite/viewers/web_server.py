"""Runs MuJoCo's web viewer in a separate process, with the reference robot and markers.

`web_page` starts this process with two sockets: the link to the task, and the socket to which
browsers connect. MuJoCo's server answers requests from all sites, so that this module checks each
request first. The header Host must be localhost, so that sites whose name resolves to this machine
(DNS rebinding) are refused. The header Origin must be the page's address.
"""

from __future__ import annotations

import http
import logging
import os
import pickle
import signal
import socket
import string
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.studio import messages, plugin, viewer_protocol, web_viewer
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.web import web_server
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.http11 import Request, Response

from isaacgymenvs_lite.rendering.markers import Marker, RobotOverlay, add_markers
from isaacgymenvs_lite.rendering.view import aim_camera

_MAX_PACKET_BYTES = 2**18
_MAX_GEOMS = 200
_MAX_MESSAGE_BYTES = 2**16
_LOCAL_NAMES = ("localhost", "127.0.0.1")
# Name of the custom numeric field in a model that contains the colour of the page's sky.
_SKY_COLOUR = "filament.clear_color"
KEYS = {
    **{f"{name.capitalize()}Arrow": name for name in ("up", "down", "left", "right")},
    "Space": "space",
    **{letter.upper(): letter for letter in string.ascii_lowercase},
    **{f"N{digit}": digit for digit in string.digits},
}
"""Maps Dear ImGui's keys to the names in `KEY_NAMES`."""


def main() -> None:
    """Serve a page until the task's process closes the link or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The task handles Ctrl-C and ends this process.
    parent, *files = map(int, sys.argv[1:])
    link, listener = (socket.socket(fileno=file) for file in files)
    server_log = logging.getLogger("WebServer")
    server_log.handlers.clear()
    server_log.setLevel(logging.WARNING)
    # The log should not report an error if a browser disconnects while it receives a state.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    # Two functions of MuJoCo's server are replaced, because it has no parameters for checks.
    web_server.bind_public_socket = lambda host, port: listener
    web_server.serve = serve_locally
    endpoint: Any = LinkEndpoint(link, parent)
    model = endpoint.wait_for_model()
    if model is None:
        return
    config = viewer_protocol.ViewerConfig(title="isaacgymenvs_lite", gfx="web")
    viewer = web_viewer.WebViewer(config, endpoint, model=model, plugins=[PagePlugin(link)])
    viewer_protocol.run_viewer_loop(viewer)
    # A normal exit destroys the viewer's native threads and objects in an undefined order.
    os._exit(0)


async def serve_locally(
    handler: Callable[[ServerConnection], Any],
    *,
    process_request: Callable[[ServerConnection, Request], Response | None],
    process_response: Callable[[ServerConnection, Request, Response], Response | None],
    **options: Any,
) -> Server:
    """Serve like `websockets.serve`, but only requests from pages of this machine."""

    def check(connection: ServerConnection, request: Request) -> Response | None:
        host = request.headers.get("Host", "")
        own_origin = f"http://{host}"
        if host.partition(":")[0] not in _LOCAL_NAMES:
            refusal = "open the page at localhost, elsewhere through ssh -L"
        elif request.headers.get("Origin", own_origin) != own_origin:
            refusal = "another site may not use this page"
        elif request.path.startswith("/drop"):
            refusal = "models cannot be dropped on this page"
        else:
            return process_request(connection, request)
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal}\n")

    def without_sharing(
        connection: ServerConnection, request: Request, response: Response
    ) -> Response:
        response = process_response(connection, request, response) or response
        for name in ("Access-Control-Allow-Origin", "Cross-Origin-Resource-Policy"):
            if name in response.headers:
                del response.headers[name]
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        return response

    options["max_size"] = _MAX_MESSAGE_BYTES
    return await serve(handler, process_request=check, process_response=without_sharing, **options)


@dataclass(frozen=True)
class BesideSnapshot(messages.Snapshot):
    """The pose (nq,) of the reference robot, and the markers."""

    reference: npt.NDArray[np.float64] | None = None
    markers: tuple[Marker, ...] = ()


class LinkEndpoint:
    """The viewer's `ViewerEndpoint`; it converts the task's packets to messages of the viewer.

    The socket may stay open after the task's process `parent` has exited, because forked children
    of the task may hold the peer socket. Therefore `parent` is checked as well.
    """

    def __init__(self, link: socket.socket, parent: int) -> None:
        self._link = link
        self._parent = parent
        self._states: list[messages.Snapshot] = []

    def wait_for_model(self) -> mujoco.MjModel | None:
        """Wait for the task's first packet, a model; return the model, or None without a task."""
        self._link.setblocking(True)
        event = self._read_packet()
        self._link.setblocking(False)
        return event.model if isinstance(event, messages.ModelEvent) else None

    def get_sim_events(self) -> list[messages.Event]:
        """Return events (new model, end of the task); the viewer calls this before each picture."""
        events: list[messages.Event] = []
        if os.getppid() != self._parent:
            return [messages.ExitEvent()]
        while not any(isinstance(event, messages.ExitEvent) for event in events):
            try:
                event = self._read_packet()
            except BlockingIOError:
                break
            if event is not None:
                events.append(event)
        return events

    def _read_packet(self) -> messages.Event | None:
        """Return the event of a model or of the task's end; store a state and return None.

        Raises:
            BlockingIOError: no packet has arrived.
        """
        try:
            packet, files, _, _ = socket.recv_fds(self._link, _MAX_PACKET_BYTES, 1)
        except ConnectionError:
            packet, files = b"", []
        if not packet:
            return messages.ExitEvent()
        if files:
            with os.fdopen(files[0], "rb") as file:
                file.seek(0)
                content = file.read()
            self._states = []  # The stored states belong to the previous model.
            model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": content})
            return messages.ModelEvent(model)
        qpos, reference, markers = pickle.loads(packet)  # The parent process, the task, is trusted.
        state = messages.StateSnapshot(qpos, int(mujoco.mjtState.mjSTATE_QPOS))
        self._states = [state, BesideSnapshot(reference, tuple(markers))]
        return None

    def get_sim_snapshots(self) -> list[messages.Snapshot]:
        """Return the newest state if it has arrived since the last call."""
        states, self._states = self._states, []
        return states

    def send_to_sim(self, message: messages.Message) -> None:
        """Drop a browser's message, so that browsers cannot change the simulation."""

    def close(self) -> None:
        """Do nothing, because the process ends after this call."""


class PagePlugin(plugin.ViewerPlugin):
    """Adds the reference robot and markers, aims the camera, and sends keys to the task."""

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        self._beside = BesideSnapshot()
        self._overlay: tuple[mujoco.MjvScene, RobotOverlay] | None = None

    @messages.handler
    def on_init(self, event: viewer_protocol.ViewerInitEvent) -> None:
        """Let the camera follow a robot with a free root, and use the colours of videos."""
        viewer = event.viewer
        aim_camera(viewer.camera, viewer.model)
        flags = list(viewer.render_flags.flags)
        # With the model's sky the floor, which reflects it, looks white.
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        if mujoco.mj_name2id(viewer.model, mujoco.mjtObj.mjOBJ_NUMERIC, _SKY_COLOUR) >= 0:
            flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0  # The sky becomes dark grey.
        viewer.render_flags.flags = flags

    @messages.handler
    def on_model(self, event: messages.PostModelEvent) -> None:
        """Forget the robot of the previous model."""
        self._overlay = None

    @messages.handler
    def on_beside(self, snapshot: BesideSnapshot) -> None:
        """Store the snapshot for the next picture."""
        self._beside = snapshot

    @messages.handler
    def add_beside(self, event: messages.UpdateEvent) -> None:
        """Add the robot and the markers to the next picture."""
        if self._overlay is None:
            model = self.viewer.model
            self._overlay = (mujoco.MjvScene(model, _MAX_GEOMS), RobotOverlay(model))
        scene, robot = self._overlay
        scene.ngeom = 0
        if self._beside.reference is not None:
            robot.add_to(scene, self._beside.reference)
        add_markers(scene, self._beside.markers)
        self.viewer.extra_geoms[:] = list(scene.geoms[: scene.ngeom])

    @messages.handler
    def send_keys(self, event: messages.UpdateEvent) -> None:
        """Send the keys that were pressed since the last picture."""
        for key, name in KEYS.items():
            # Keys pressed together with Ctrl and repetitions of a held key are left out.
            if imgui.IsKeyChordPressed(imgui.Key.__members__[key]):
                try:
                    self._link.send(name.encode())
                except OSError:  # The socket is full, or the task ended (the endpoint reports it).
                    return
