"""The page, with a headless Chromium if it is installed."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import isaacgymenvs_lite
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.viewers.web_page import WebPage, check_page
from tests.viewers.browser import CHROMIUM, Browser
from tests.viewers.conftest import has_ended


def test_a_port_in_use_is_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"viewer_port={port}: cannot listen") as caught:
            check_page(port)
    assert "\n" not in str(caught.value)
    check_page(port)  # free again


@pytest.fixture
def env(make_env, walk_clip):
    env = make_env("task=HumanoidAMP", "num_envs=2", f"task.env.motion_file={walk_clip}")
    env.reset()
    env.reset_done()
    return env


@pytest.fixture
def page(env):
    page = WebPage(env, 0, real_time=True)
    env.listeners.append(page)
    return page


def play(env, seconds: float) -> int:
    """Let an untrained policy twitch; return the steps."""
    generator, steps = torch.Generator().manual_seed(0), 0
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        env.reset_done()
        env.step(0.5 * torch.randn(env.num_envs, env.num_actions, generator=generator))
        steps += 1
    return steps


def asked(page, path: str = "/", **headers: str) -> tuple[int, bytes]:
    """Return status and content of an answer to a request with these headers."""
    request = urllib.request.Request(page.url.rstrip("/") + path, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            assert "Access-Control-Allow-Origin" not in answer.headers
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_the_page_is_served_on_this_machine_only(page, capfd):
    status, content = asked(page)
    assert status == 200 and b"<html" in content.lower()
    port = page.url.split(":")[-1].strip("/")
    with pytest.raises(OSError):
        socket.create_connection(("::1", int(port)))
    # A tunnel may have another port; a site that resolves to this machine has another name.
    assert asked(page, Host="localhost:9000")[0] == 200
    for headers in (
        {"Host": f"evil.example.org:{port}"},
        {"Host": ""},
        {"Origin": "http://evil.example.org"},
        {"Origin": "http://localhost:3000"},
        {"Origin": "null"},
    ):
        assert asked(page, "/model", **headers)[0] == 403, headers
    assert page.keeps_playing
    page.close()
    page.close()
    assert not page.keeps_playing and has_ended(page.process.pid)
    with pytest.raises(OSError):
        urllib.request.urlopen(page.url, timeout=2)
    assert capfd.readouterr().out == ""


def test_sockets_are_for_the_page_only(page):
    address = page.url.replace("http", "ws")
    for path, origin in (("state", "http://evil.example.org"), ("drop", None)):
        with pytest.raises(InvalidStatus, match="403"):
            connect(address + path, origin=origin)
    with connect(address + "state", origin=page.url.rstrip("/")) as state:
        assert state.recv(timeout=30)


# Not guarded by `if __name__ == "__main__"`, and in a folder without the package.
SCRIPT = f"""
import os, sys, time
sys.path.insert(0, {str(Path(isaacgymenvs_lite.__file__).parents[1])!r})
import isaacgymenvs_lite
from isaacgymenvs_lite.viewers.web_page import WebPage
page = WebPage(isaacgymenvs_lite.make(task="Cartpole", num_envs=1), 0, real_time=False)
if os.fork():
    print(page.process.pid, flush=True)
time.sleep(600)
"""


@pytest.mark.slow
def test_the_page_ends_when_the_task_is_killed(tmp_path, monkeypatch):
    """Also while a process that the task has forked holds the task's files."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    command = [sys.executable, str(script)]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.kill()
        end_s = time.monotonic() + 30.0
        while not has_ended(pid):
            assert time.monotonic() < end_s
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)


def test_the_task_goes_on_when_its_page_is_killed(env, page, caplog):
    os.kill(page.process.pid, signal.SIGKILL)
    while page.keeps_playing:
        time.sleep(0.01)
    play(env, 0.3)
    env.render(mode="human")
    (warning,) = [record.message for record in caplog.records if "viewer=web" in record.message]
    assert "ended (Killed); the run goes on" in warning


@pytest.mark.slow
def test_the_task_does_not_wait_for_a_page_that_hangs(env, page):
    os.kill(page.process.pid, signal.SIGSTOP)
    for _ in range(2000):
        page.render()
    play(env, 0.2)
    page.close()
    assert has_ended(page.process.pid)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
def test_a_browser_shows_the_character_and_sends_keys(env, page, tmp_path):
    env.pressed = []
    env.on_key = env.pressed.append
    with Browser(tmp_path / "profile", page.url) as browser:
        for _ in range(20):
            play(env, 1.0)
            image = browser.screenshot()
            if is_drawn(image):
                break
        assert is_drawn(image)
        before = browser.screenshot()
        play(env, 1.0)
        assert (np.abs(browser.screenshot().astype(int) - before) > 30).any(axis=2).mean() > 0.002
        press(browser, env, "ArrowUp", "ArrowUp", 38)
        press(browser, env, "r", "KeyR", ord("R"))
    assert env.pressed == ["up", "r"]


def press(browser: Browser, env, key: str, code: str, number: int) -> None:
    """Press a key until it arrives: a browser without a GPU looks at keys once in a second."""
    count, end_s = len(env.pressed), time.monotonic() + 60.0
    about = {"key": key, "code": code, "windowsVirtualKeyCode": number}
    while len(env.pressed) == count:
        assert time.monotonic() < end_s
        browser.call("Input.dispatchKeyEvent", type="keyDown", **about)
        for _ in range(15):
            if len(env.pressed) == count:
                play(env, 0.2)
        browser.call("Input.dispatchKeyEvent", type="keyUp", **about)


@pytest.mark.slow
def test_a_play_goes_on_until_ctrl_c(tmp_path):
    words = ["task=Cartpole", "test=True", "num_envs=2", "viewer=web", "viewer_port=0"]
    words += ["num_threads=1", "+train.params.config.player.games_num=2"]
    command = [sys.executable, str(Path(__file__).parents[2] / "train.py"), *words]
    with subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stderr is not None
        said = ""
        while "playing on" not in said:
            line = process.stderr.readline()
            assert line, said
            said += line
        assert "played 2 episodes" in said
        (url,) = re.findall(r"http://\S+", said)
        time.sleep(0.5)
        with urllib.request.urlopen(url) as answer:
            assert b"<html" in answer.read().lower()
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        rest = process.stderr.read()
        assert process.wait(timeout=30) == 0, rest
    assert "Traceback" not in rest


def is_drawn(image: np.ndarray) -> bool:
    """Whether something coloured, such as the character, is in the picture."""
    pixels = image[:-40].astype(int)  # without the line of status
    return bool((pixels.max(axis=2) - pixels.min(axis=2) > 70).mean() > 0.005)
