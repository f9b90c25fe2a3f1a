"""The process of a page: started and ended by the task's, which it cannot harm.

MuJoCo's web viewer is native code with threads of its own. In the task's process a fault of it, or
Python's garbage collector at the wrong moment, ended a training.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import mujoco

import isaacgymenvs_lite
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.viewers.web_link import PageEnd, TaskEnd, make_link

_START_TIMEOUT_S = 60.0
_CLOSE_TIMEOUT_S = 3.0
_PROGRAM = "from isaacgymenvs_lite.viewers.web_process import main; main()"


class PageProcess:
    """A page that is served by a process of its own.

    Args:
        model: what it shows at first.
        host: name or address of this machine, where to listen.
        port: 0 takes a free one.
        allowed_hosts: see `PageGuard`.

    Attributes:
        link: sends states and models to the page, and receives keys.
        port: where browsers connect.
        token: secret that browsers need; '' if only this machine reaches the page.
        pid: of the process.

    Raises:
        ConfigError: it does not start; the message has the reason.
    """

    def __init__(
        self, model: mujoco.MjModel, host: str, port: int, allowed_hosts: Sequence[str] = ()
    ) -> None:
        here, there = make_link()
        self.link = TaskEnd(here)
        with there:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-c", _PROGRAM),
                    *(str(there.fileno()), host, str(port), *allowed_hosts),
                ],
                pass_fds=[there.fileno()],
                env={**os.environ, "PYTHONPATH": _import_path()},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                process_group=0,  # a terminal's Ctrl-C is for the task, which then closes the page
            )
        self.pid = self._process.pid
        try:
            self.link.send_model(model)
            self.port, self.token = self._wait_for_start()
        except BaseException:
            self.close()
            raise

    def _wait_for_start(self) -> tuple[int, str]:
        try:
            start = self.link.wait_for_start(_START_TIMEOUT_S)
        except TimeoutError:
            raise ConfigError(
                f"viewer=web: its process did not start within {_START_TIMEOUT_S:.0f} s"
            ) from None
        if start is None:
            self.close()
            how = self.how_it_ended()
            raise ConfigError(f"viewer=web: its process ended before it served a page ({how})")
        if "error" in start:
            raise ConfigError(start["error"])
        return start["port"], start["token"]

    def is_running(self) -> bool:
        """Return whether the process has not ended."""
        return self._process.poll() is None

    def how_it_ended(self) -> str:
        """Return the exit status or the signal of a process that has ended."""
        status = self._process.poll() or 0
        return f"exit status {status}" if status >= 0 else signal.strsignal(-status) or str(status)

    def close(self) -> None:
        """End the process, within seconds; a second call does nothing."""
        self.link.close()
        try:
            self._process.wait(_CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def missing_viewer(reason: object) -> str:
    """Return the message for a viewer that cannot be imported."""
    return (
        f"viewer=web needs MuJoCo's web viewer, which cannot be imported ({reason}); pip install"
        " mujoco-studio"
    )


def no_listening(host: str, port: int, reason: object) -> str:
    """Return the message for an address at which no page can be served."""
    return (
        f"viewer_port={port}: cannot listen at {host[:80]}:{port} ({reason}); choose another port,"
        " 0 takes a free one"
    )


def _import_path() -> str:
    """Return PYTHONPATH for a process that imports what this one does, in any folder."""
    folders = [os.path.abspath(folder) for folder in sys.path if folder]
    package = str(Path(isaacgymenvs_lite.__file__).parents[1])
    # This one may have found it in the folder that was the current one.
    return os.pathsep.join(folders if package in folders else [package, *folders])


def main() -> None:
    """Serve a page until the task's process closes the link, or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the task decides what Ctrl-C ends
    file, host, port, *allowed_hosts = sys.argv[1:]
    link = PageEnd(socket.socket(fileno=int(file)))
    model = link.wait_for_model()
    if model is None:
        return
    try:
        from isaacgymenvs_lite.viewers.web_server import open_page

        page = open_page(link, model, host, int(port), allowed_hosts)
    except ImportError as error:
        link.send_start(error=missing_viewer(error))
        return
    except OSError as error:
        link.send_start(error=no_listening(host, int(port), error.strerror or error))
        return
    link.send_start(port=page.port, token=page.token)
    page.serve()
    # Native threads and objects of the viewer would be freed in any order.
    os._exit(0)
