"""The page, with a headless Chromium if it is installed."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.scene import SceneRenderer
from isaacgymenvs_lite.rendering.tracks import PoseReader
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.viewers.web_page import WebPage, check_page
from tests.viewers.browser import CHROMIUM, Browser
from tests.viewers.conftest import has_ended


def test_a_port_in_use_is_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"viewer_port={port}: cannot listen") as caught:
            check_page("localhost", port)
    assert "\n" not in str(caught.value)
    check_page("localhost", port)  # free again


def test_another_machines_address_is_one_line():
    with pytest.raises(ConfigError, match=r"cannot listen at 192\.0\.2\.1"):
        check_page("192.0.2.1", 0)


@pytest.fixture
def env(make_env, walk_clip):
    env = make_env("task=HumanoidAMP", "num_envs=2", f"task.env.motion_file={walk_clip}")
    env.reset()
    env.reset_done()
    return env


@pytest.fixture
def page(env):
    page = WebPage(env, "localhost", 0, real_time=True)
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


def test_the_page_is_served_on_this_machine_only(page, capfd):
    with urllib.request.urlopen(page.url) as answer:
        assert b"<html" in answer.read().lower()
    port = int(page.url.split(":")[-1].strip("/"))
    family = socket.AF_INET6
    with socket.socket(family) as other, pytest.raises(OSError):
        other.connect(("::1", port))
    assert page.keeps_playing
    page.close()
    assert not page.keeps_playing
    page.close()
    with pytest.raises(OSError):
        urllib.request.urlopen(page.url, timeout=2)
    assert capfd.readouterr().out == ""


def test_pages_can_be_opened_one_after_the_other(env):
    for _ in range(5):
        page = WebPage(env, "localhost", 0, real_time=False)
        with urllib.request.urlopen(f"{page.url}model?total_bytes") as answer:
            assert int(json.load(answer)["total_bytes"]) > 10_000
        page.close()
        assert has_ended(page.process.pid)


def test_the_task_goes_on_when_its_page_is_killed(env, page, caplog):
    os.kill(page.process.pid, signal.SIGKILL)
    while page.keeps_playing:
        time.sleep(0.01)
    play(env, 0.3)
    env.render(mode="human")
    (warning,) = [record.message for record in caplog.records if "viewer=web" in record.message]
    assert "ended (Killed); the run goes on" in warning


def test_the_task_does_not_wait_for_a_page_that_hangs(env, page):
    os.kill(page.process.pid, signal.SIGSTOP)
    qpos = np.zeros(env.simulation.model.nq)
    while page.process.link.send_state(qpos):
        pass
    assert not page.process.link.send_model(env.simulation.model)
    play(env, 0.2)
    page.close()
    assert has_ended(page.process.pid)


def test_rough_ground_follows_the_robot(make_env):
    small = ("numLevels=2", "numTerrains=2", "mapLength=20", "mapWidth=20")
    words = [f"++task.env.terrain.{word}" for word in small]
    env = make_env("task=AnymalTerrain", "num_envs=1", *words)
    env.reset()
    page = WebPage(env, "localhost", 0, real_time=False)
    env.listeners.append(page)

    def shown() -> bytes:
        with urllib.request.urlopen(f"{page.url}model") as answer:
            return answer.read()

    before, state = shown(), env.simulation
    roots = state.root_states.clone()
    roots[:, :2] += 6.0
    env.simulation.write_state(torch.tensor([0]), roots, state.dof_pos, state.dof_vel)
    env.render(mode="human")
    end_s = time.monotonic() + 30.0
    while shown() == before:
        assert time.monotonic() < end_s
        time.sleep(0.05)


@pytest.mark.usefixtures("page")
def test_the_task_is_no_faster_than_what_it_simulates(env):
    play(env, 0.3)
    assert play(env, 1.0) <= 1.0 / env.simulation.dt + 2


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


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
def test_the_colours_are_those_of_videos(env, page, gl, tmp_path):
    model, qpos = env.simulation.model, PoseReader(env)(0)
    with Browser(tmp_path / "profile", page.url) as browser:
        for _ in range(20):
            play(env, 1.0)
            shown = browser.screenshot()
            if is_drawn(shown):
                break
    height, width = shown[:-40].shape[:2]  # without the line of status
    with SceneRenderer(model, width, height, view=View.of_model(model)) as renderer:
        recorded = renderer.draw(qpos)
    for row in (10, height - 10):  # sky, floor
        for column in (20, width - 20):
            off = shown[row, column].astype(int) - recorded[row, column]
            assert np.abs(off).max() < 45, (row, column, shown[row, column], recorded[row, column])


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


def test_another_system_is_one_line(monkeypatch):
    monkeypatch.delattr(os, "memfd_create")
    with pytest.raises(ConfigError, match="viewer=web runs on Linux only so far"):
        check_page("localhost", 0)
