"""The page's process: how it starts, and when it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import mujoco
import pytest

import isaacgymenvs_lite
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.viewers.web_process import PageProcess
from tests.viewers.conftest import has_ended

# Not guarded by `if __name__ == "__main__"`, and in a folder without the package.
SCRIPT = f"""
import os, sys, time, mujoco
sys.path.insert(0, {str(Path(isaacgymenvs_lite.__file__).parents[1])!r})
from isaacgymenvs_lite.viewers.web_process import PageProcess
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
page = PageProcess(model, "localhost", 0)
if sys.argv[1:] != ["forks"] or os.fork():
    print(page.pid, page.port, flush=True)
time.sleep(600)
"""


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")


@pytest.mark.parametrize("how", [(), ("forks",)])
def test_the_page_ends_when_the_task_is_killed(tmp_path, monkeypatch, how):
    """Also if a process that the task has forked holds the task's files."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    command = [sys.executable, str(script), *how]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as task:
        assert task.stdout is not None
        try:
            pid, port = map(int, task.stdout.readline().split())
            os.kill(pid, signal.SIGINT)  # which is for the task
            with urllib.request.urlopen(f"http://localhost:{port}/") as answer:
                assert b"<html" in answer.read().lower()
            task.kill()
            end_s = time.monotonic() + 30.0
            while not has_ended(pid):
                assert time.monotonic() < end_s
                time.sleep(0.05)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(task.pid, signal.SIGKILL)  # and what it has forked


def test_a_port_that_was_taken_meanwhile_is_one_line(model):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"viewer_port={port}: cannot listen") as caught:
            PageProcess(model, "localhost", port)
    assert "\n" not in str(caught.value)


def test_a_viewer_that_cannot_be_imported_is_one_line(model, tmp_path, monkeypatch):
    (tmp_path / "websockets.py").write_text("raise ImportError('broken')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"cannot be imported \(broken\); pip install"):
        PageProcess(model, "localhost", 0)


def test_a_process_that_fails_at_its_start_is_one_line(model, tmp_path, monkeypatch, capfd):
    (tmp_path / "mujoco.py").write_text("raise SystemExit(7)")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"ended before it served a page \(exit status 7\)"):
        PageProcess(model, "localhost", 0)
    assert capfd.readouterr() == ("", "")


def test_nothing_is_left_when_the_start_is_interrupted(model, monkeypatch):
    started = []
    popen = subprocess.Popen

    def interrupt(*args, **options):
        started.append(popen(*args, **options))
        os.kill(os.getpid(), signal.SIGINT)
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", interrupt)
    with contextlib.suppress(KeyboardInterrupt):
        PageProcess(model, "localhost", 0)
    (process,) = started
    assert process.wait(10) is not None
