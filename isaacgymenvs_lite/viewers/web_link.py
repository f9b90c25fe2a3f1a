"""The socket between a task and the process of its page: models and states go there, keys back.

A message is one packet, sent as a whole or not at all, so that neither side waits for the other. A
model, which may be larger than a packet, goes as a file in memory.
"""

from __future__ import annotations

import json
import os
import select
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.rendering.markers import (
    MARKER_NUMBERS,
    Marker,
    pack_markers,
    unpack_markers,
)

Pose = npt.NDArray[np.float64]

_MODEL, _STATE = b"M", b"S"
# A packet is shorter: it fits into the buffer of a socket.
_MAX_PACKET_BYTES = 2**18
_MAX_START_BYTES = 2**16
# Longer than any key's name.
_MAX_KEY_BYTES = 16
# Keys that are read at a time; `TaskKeys` lets fewer pass.
_MAX_KEYS = 64


def make_link() -> tuple[socket.socket, socket.socket]:
    """Return two connected sockets, for a `TaskEnd` and a `PageEnd`."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


class TaskEnd:
    """The task's end. Nothing here waits, except for the start.

    Args:
        link: one of the two sockets; `close` closes it.
    """

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        link.setblocking(False)
        self._room = select.poll()
        self._room.register(link, select.POLLOUT)

    def send_model(self, model: mujoco.MjModel) -> bool:
        """Send what the page shows from now on; return whether there was room."""
        if not self._has_room():
            return False
        content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, content)
        with os.fdopen(os.memfd_create("model.mjb"), "wb") as file:
            file.write(content.data)
            file.flush()
            return self._send(_MODEL, file.fileno())

    def send_state(
        self, qpos: Pose, reference: Pose | None = None, markers: Iterable[Marker] = ()
    ) -> bool:
        """Send joint positions (nq,), and what is beside the robot; return whether there was room.

        Args:
            qpos: of the model that was sent last.
            reference: of the translucent robot beside it, if there is one.
            markers: of the goal.
        """
        poses = [qpos] if reference is None else [qpos, reference]
        numbers = np.concatenate([*poses, pack_markers(markers).ravel()], dtype=np.float64)
        packet = _STATE + bytes([len(poses)]) + numbers.tobytes()
        return self._has_room() and self._send(packet)

    def _has_room(self) -> bool:
        return any(event & select.POLLOUT for _, event in self._room.poll(0))

    def _send(self, packet: bytes, *files: int) -> bool:
        try:
            socket.send_fds(self._link, [packet], files)
        except OSError:  # no room, or the other end is closed
            return False
        return True

    def wait_for_start(self, timeout_s: float) -> dict[str, Any] | None:
        """Return what the page says once it is served, or why it is not; None: it has ended.

        Raises:
            TimeoutError: it says nothing for so long.
        """
        self._link.settimeout(timeout_s)
        try:
            packet = self._link.recv(_MAX_START_BYTES)
        except ConnectionError:
            return None
        finally:
            self._link.setblocking(False)
        return json.loads(packet) if packet else None

    def pressed_keys(self) -> list[str]:
        """Return the keys that were pressed since the last call, at most 64."""
        pressed: list[str] = []
        while len(pressed) < _MAX_KEYS:
            try:
                packet = self._link.recv(_MAX_KEY_BYTES)
            except OSError:  # none, or the other end is closed
                break
            if not packet:
                break
            pressed.append(packet.decode("ascii", "replace"))
        return pressed

    def close(self) -> None:
        """Close the socket, which ends the page; a second call does nothing."""
        self._link.close()


@dataclass
class Update:
    """What arrived at a page; of several states the last one.

    Attributes:
        model: a new one, or None.
        qpos: (nq,) of the new model, else of the one before; None: no new state.
        reference: (nq,) of the translucent robot; None: there is none, or no new state.
        markers: of the new state.
        has_ended: whether the task closed its end.
    """

    model: mujoco.MjModel | None = None
    qpos: Pose | None = None
    reference: Pose | None = None
    markers: tuple[Marker, ...] = ()
    has_ended: bool = False


class PageEnd:
    """The end of the page's process.

    Args:
        link: one of the two sockets.
    """

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        # The socket alone would not do: processes that the task has forked may hold its other end.
        self._parent = os.getppid()
        self._num_positions = 0

    def wait_for_model(self) -> mujoco.MjModel | None:
        """Return the first model; None if the task ended before."""
        self._link.setblocking(True)
        update = Update()
        self._read_packet(update)
        self._link.setblocking(False)
        return update.model

    def receive(self) -> Update:
        """Return what arrived since the last call, without waiting."""
        update = Update(has_ended=os.getppid() != self._parent)
        while not update.has_ended:
            try:
                self._read_packet(update)
            except BlockingIOError:
                break
        return update

    def _read_packet(self, update: Update) -> None:
        """Read one packet into `update`.

        Raises:
            BlockingIOError: none has arrived.
        """
        try:
            packet, files, _, _ = socket.recv_fds(self._link, _MAX_PACKET_BYTES, 1)
        except ConnectionError:
            packet, files = b"", []
        if packet == _MODEL:
            model = _read_model(files[0])
            update.model, update.qpos, self._num_positions = model, None, model.nq
        elif packet:
            num_poses, numbers = packet[len(_STATE)], np.frombuffer(packet[len(_STATE) + 1 :])
            size = num_poses * self._num_positions
            poses = numbers[:size].reshape(num_poses, -1)
            update.qpos, update.reference = poses[0], poses[1] if num_poses > 1 else None
            update.markers = unpack_markers(numbers[size:].reshape(-1, MARKER_NUMBERS))
        else:
            update.has_ended = True

    def send_start(self, **about: Any) -> None:
        """Send what `TaskEnd.wait_for_start` returns."""
        self._send(json.dumps(about).encode())

    def send_key(self, name: str) -> None:
        """Send a key that was pressed, or drop it if there is no room."""
        self._send(name.encode())

    def _send(self, packet: bytes) -> None:
        try:
            self._link.send(packet)
        except OSError:  # no room, or the task ended, which `receive` reports
            return


def _read_model(file: int) -> mujoco.MjModel:
    with os.fdopen(file, "rb") as content:
        content.seek(0)
        return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": content.read()})
