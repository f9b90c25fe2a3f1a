"""Files that can be looked into, and small tasks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.viewers import videos
from tests.tiny import ONE_THREAD, composed


@pytest.fixture
def small_pictures(monkeypatch) -> None:
    monkeypatch.setattr(videos, "SINGLE_SIZE", (160, 120))
    monkeypatch.setattr(videos, "TILE_SIZE", (80, 60))


@pytest.fixture
def make_env() -> Iterator[Callable[..., Any]]:
    """Return make(*overrides), a task on one thread."""
    envs = []

    def make(*overrides: str) -> Any:
        seed_everything(0)
        cfg = composed([*ONE_THREAD, *overrides])
        env = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
        envs.append(env)
        return env

    yield make
    for env in envs:
        env.close()


class KeyedTask:
    """A task that lists the keys that it receives."""

    def __init__(self) -> None:
        self.pressed: list[str] = []
        self.on_key = self.pressed.append


def frames_of(path: Path) -> tuple[np.ndarray, float]:
    """Return the pictures (T, height, width, 3) of a video, and how many there are in a second."""
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        return np.array(frames), float(container.streams.video[0].average_rate or 0)


def assert_is_a_video(frames: np.ndarray, num_frames: int) -> None:
    """Pictures that are not black, show something, and move."""
    assert len(frames) == num_frames
    assert frames.mean() > 60
    assert min(frame.std() for frame in frames) > 10
    # noise of the encoder is a few units, at single pixels
    difference = np.abs(frames[-1].astype(int) - frames[0])
    assert (difference > 30).mean() > 0.001


def has_ended(pid: int) -> bool:
    """Return whether a process has ended, also where nobody has asked for its exit status."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True
