"""The window's keys; the window itself under a virtual display, where there is one."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from isaacgymenvs_lite.viewers.window import Keys
from tests.viewers.conftest import KeyedTask, assert_is_a_video, frames_of

ESCAPE = 256


def test_what_the_keys_mean():
    task = KeyedTask()
    keys = Keys(task)
    assert (keys.sync, keys.recording, keys.quit) == (True, False, False)
    for key in (ord("V"), ord("R"), ord("X")):
        keys.press(key)
    assert keys.sync  # only the task's thread applies them
    keys.update()
    assert (keys.sync, keys.recording, keys.quit) == (False, True, False)
    for key in (ord("V"), ord("R"), ESCAPE):
        keys.press(key)
    keys.update()
    assert (keys.sync, keys.recording, keys.quit) == (True, False, True)
    assert task.pressed == ["x"]


def test_other_keys_are_the_tasks():
    task = KeyedTask()
    keys = Keys(task)
    # GLFW's codes: the arrows in the order right, left, down, up; then F1 and ;
    for key in (262, 263, 264, 265, ord(" "), ord("A"), ord("9"), 290, ord(";")):
        keys.press(key)
    assert task.pressed == []
    keys.update()
    assert task.pressed == ["right", "left", "down", "up", "space", "a", "9"]


@pytest.fixture
def display(tmp_path: Path, monkeypatch) -> Iterator[str]:
    """A virtual display of its own."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb")
    reader, writer = os.pipe()
    options = ["-displayfd", str(writer), "-screen", "0", "640x480x24"]
    process = subprocess.Popen(
        ["Xvfb", *options], pass_fds=[writer], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    os.close(writer)
    with os.fdopen(reader) as lines:
        number = lines.readline().strip()
    monkeypatch.setenv("DISPLAY", f":{number}")
    yield number
    process.terminate()
    process.wait(timeout=10)


SCRIPT = """
import sys, time
from pathlib import Path
import isaacgymenvs_lite
from isaacgymenvs_lite.viewers.window import Window

env = isaacgymenvs_lite.make(task="HumanoidAMP", num_envs=2)
quits = []
window = Window(env, Path(sys.argv[1]), lambda: quits.append("end"))
env.listeners.append(window)

def step(seconds):
    start, steps = time.monotonic(), 0
    while time.monotonic() < start + seconds:
        env.reset_done()
        env.step(env.zero_actions())
        steps += 1
    return steps

step(0.5)
assert step(1.0) <= 32, "faster than what is simulated"
window.keys.press(ord("R"))
step(0.5)
window.keys.press(ord("R"))
step(0.1)
window.keys.press(256)
step(0.2)
assert quits == ["end"], quits
env.close()
"""


@pytest.mark.slow
@pytest.mark.usefixtures("gl", "display")
def test_a_window_shows_records_and_ends(tmp_path):
    """In a process of its own: GLFW does not let go of a display."""
    command = [sys.executable, "-c", SCRIPT, str(tmp_path)]
    start_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert time.monotonic() - start_s > 2.0
    (path,) = tmp_path.glob("window-step-*.mp4")
    frames, _ = frames_of(path)
    assert_is_a_video(frames, len(frames))
