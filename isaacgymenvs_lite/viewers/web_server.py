"""MuJoCo's web viewer in the process of a page: guarded, and with a robot beside the character.

It imports all of `mujoco.studio`; only `web_process.main` imports it.
"""

from __future__ import annotations

import logging
import socket
import string
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
from mujoco.studio import messages, plugin, viewer_protocol, web_viewer
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.web import web_server

from isaacgymenvs_lite.rendering.markers import Marker, add_markers
from isaacgymenvs_lite.rendering.view import aim_camera
from isaacgymenvs_lite.viewers.robot_overlay import RobotOverlay
from isaacgymenvs_lite.viewers.web_guard import PageGuard, address_of
from isaacgymenvs_lite.viewers.web_link import PageEnd, Pose

_START_TIMEOUT_S = 20.0
_MAX_GEOMS = 200
# Custom number of a model with the colour of the page's sky.
_SKY_COLOUR = "filament.clear_color"
KEYS = {
    **{f"{name.capitalize()}Arrow": name for name in ("up", "down", "left", "right")},
    "Space": "space",
    **{letter.upper(): letter for letter in string.ascii_lowercase},
    **{f"N{digit}": digit for digit in string.digits},
}
"""The names in `KEY_NAMES`, by Dear ImGui's."""


@dataclass(frozen=True)
class Page:
    """A page to which browsers can connect.

    Attributes:
        viewer: shows the model.
        port: where browsers connect.
        token: secret that browsers need; '' if only this machine reaches the page.
    """

    viewer: viewer_protocol.Viewer
    port: int
    token: str

    def serve(self) -> None:
        """Serve the page until the task ends."""
        viewer_protocol.run_viewer_loop(self.viewer)


def open_page(
    link: PageEnd, model: mujoco.MjModel, host: str, port: int, allowed_hosts: Iterable[str]
) -> Page:
    """Return a page that browsers can open; call it once in a process.

    Args:
        link: to the task.
        model: what is shown at first.
        host: name or address of this machine, where to listen.
        port: 0 takes a free one.
        allowed_hosts: see `PageGuard`.

    Raises:
        OSError: the port is taken, or the server does not start.
    """
    _silence_server_log()
    address = address_of(host)
    port = port or _free_port(address)
    guard = PageGuard(host, address, port, allowed_hosts)
    # MuJoCo's server has no parameter for limits, so its name of `websockets.serve` is replaced. A
    # version that no longer calls it is not served at all.
    web_server.serve = guard.serve
    PageViewer.address = address
    config = viewer_protocol.ViewerConfig(title="isaacgymenvs_lite", gfx="web", http_port=port)
    endpoint: Any = LinkEndpoint(link)
    try:
        viewer = PageViewer(config, endpoint, model=model, plugins=[PagePlugin(link)])
    except RuntimeError as error:  # MuJoCo's, for a port that was taken meanwhile
        raise OSError(str(error)) from error
    if not guard.started.wait(_START_TIMEOUT_S):
        raise TimeoutError(f"MuJoCo's server did not start within {_START_TIMEOUT_S:.0f} s")
    return Page(viewer, port, guard.token)


@dataclass(frozen=True)
class BesideSnapshot(messages.Snapshot):
    """What is drawn beside the character.

    Attributes:
        reference: (nq,) joint positions of the translucent robot; None: there is none.
        markers: of the goal.
    """

    reference: Pose | None = None
    markers: tuple[Marker, ...] = ()


class LinkEndpoint:
    """The viewer's `ViewerEndpoint`: what the task sends becomes its messages.

    Args:
        link: to the task.
    """

    def __init__(self, link: PageEnd) -> None:
        self._link = link
        self._states: list[messages.Snapshot] = []

    def get_sim_events(self) -> list[messages.Event]:
        """Return a new model, or the end; the viewer asks before each picture."""
        update = self._link.receive()
        if update.has_ended:
            return [messages.ExitEvent()]
        if update.qpos is not None:
            state = messages.StateSnapshot(update.qpos, int(mujoco.mjtState.mjSTATE_QPOS))
            self._states = [state, BesideSnapshot(update.reference, update.markers)]
        return [] if update.model is None else [messages.ModelEvent(update.model)]

    def get_sim_snapshots(self) -> list[messages.Snapshot]:
        """Return the newest state, once."""
        states, self._states = self._states, []
        return states

    def send_to_sim(self, message: messages.Message) -> None:
        """Drop what a browser would change in the simulation."""

    def close(self) -> None:
        """Do nothing: the process ends next."""


class PagePlugin(plugin.ViewerPlugin):
    """Adds what is beside the character, aims the camera, and passes keys on.

    Args:
        link: to the task.
    """

    def __init__(self, link: PageEnd) -> None:
        self._link = link
        self._beside = BesideSnapshot()
        self._overlay: tuple[mujoco.MjvScene, RobotOverlay] | None = None

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
    def on_model(self, event: messages.PostModelEvent) -> None:
        """Forget the robot of the model before."""
        self._overlay = None

    @messages.handler
    def on_beside(self, snapshot: BesideSnapshot) -> None:
        """Store it for the next picture."""
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
            # Not with Ctrl and the like, nor again while it is held.
            if imgui.IsKeyChordPressed(imgui.Key.__members__[key]):
                self._link.send_key(name)


class PageViewer(web_viewer.WebViewer):
    """Listens at one address in place of all of them.

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


def _silence_server_log() -> None:
    """Keep the server's lines about connections out of the log."""
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
