from __future__ import annotations

import importlib.util
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import PIL.Image
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError, MissingPackageError
from isaacgymenvs_lite.rendering.markers import Sphere
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.rendering.video import draw_tracks, save_video
from isaacgymenvs_lite.viewers.reference_overlay import reference_track


def pictures(number: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """A bright square that wanders to the right on grey."""
    images = [np.full((height, width, 3), 90, np.uint8) for _ in range(number)]
    for i, image in enumerate(images):
        image[16:32, 4 * i : 4 * i + 16] = (250, 120, 30)
    return images


def decode(path: Path) -> tuple[list[np.ndarray], Fraction]:
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        return frames, container.streams.video[0].average_rate


def test_a_video_of_a_task_moves_and_is_not_black(gl, make_env, tmp_path):
    env = make_env("task.env.stateInit=Start")
    recorder = PoseRecorder(env, num_steps=8, env_ids=(0, 1))
    generator = torch.Generator().manual_seed(1)
    for _ in range(8):
        env.step(2.0 * torch.rand(3, 28, generator=generator) - 1.0)
        recorder.step()
    tracks = recorder.tracks()
    tracks.append(reference_track(env, tracks[0]))
    images = draw_tracks(env.simulation.model, tracks, ("a", "b", "clip"), width=80, height=120)
    path = save_video(tmp_path / "task.mp4", images, 1.0 / env.dt)

    frames, rate = decode(path)
    assert len(frames) == 8
    assert float(rate) == pytest.approx(30.12, abs=0.01)  # control steps of 2 * 0.0166 s
    for frame in frames:
        assert frame.shape == (120, 240, 3)
        assert frame.mean() > 100
        assert frame.std() > 20
    # in each panel something moves that is no noise of the encoder
    for panel in range(3):
        columns = slice(80 * panel, 80 * (panel + 1))
        difference = np.abs(frames[7][:, columns].astype(int) - frames[0][:, columns])
        assert difference.max() > 60, panel
        assert (difference > 30).mean() > 0.005, panel


def test_each_panel_has_marks_of_its_own(gl, humanoid):
    tracks = [np.repeat(humanoid.qpos0[None], number, axis=0) for number in (2, 3)]
    ball = Sphere((0.5, 0.0, 0.8), 0.3, (1.0, 0.0, 0.0))
    plain = list(draw_tracks(humanoid, tracks, width=64, height=64))
    assert len(plain) == 2  # until the shortest track ends
    markers = [((ball,), ()), ((), (ball,))]
    marked = list(draw_tracks(humanoid, tracks, markers=markers, width=64, height=64))
    for time, panel in ((0, 0), (1, 1)):
        changed = (plain[time] != marked[time]).any(axis=(0, 2)).nonzero()[0] // 64
        assert set(changed) == {panel}


def test_what_is_encoded_can_be_decoded(tmp_path):
    images = pictures(10)
    (tmp_path / "square.mp4").write_bytes(b"x" * 100_000)  # an older file is replaced
    frames, rate = decode(save_video(tmp_path / "square.mp4", images, 25.0))
    assert rate == 25
    assert len(frames) == 10
    for frame, image in zip(frames, images, strict=True):
        # lossy, and colours at half the resolution
        assert np.abs(frame.astype(int) - image).mean() < 6


def test_webp_is_an_animation_for_ever(tmp_path):
    path = save_video(tmp_path / "square.webp", pictures(10), 20.0)
    with PIL.Image.open(path) as image:
        assert (image.n_frames, image.size, image.info["loop"]) == (10, (64, 48), 0)
        image.seek(1)
        image.load()
        assert image.info["duration"] == 50


def test_without_pictures_there_is_no_file(tmp_path):
    save_video(tmp_path / "none.mp4", [], 25.0)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_written_is_refused(tmp_path):
    for name, words in (
        ("nowhere/square.mp4", ["cannot write", "nowhere"]),
        ("square.avi", [".avi", ".mp4", ".webp"]),
        ("square", ["video format", ".mp4"]),
    ):
        with pytest.raises(ConfigError) as caught:
            save_video(tmp_path / name, pictures(1), 25.0)
        assert "\n" not in str(caught.value)
        assert all(word in str(caught.value) for word in words)


def test_a_disk_without_room_is_one_line(tmp_path):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    (tmp_path / "full.mp4").symlink_to("/dev/full")
    with pytest.raises(ConfigError, match="No space left") as caught:
        save_video(tmp_path / "full.mp4", pictures(200, 480, 640), 25.0)
    assert "\n" not in str(caught.value)


def test_missing_pyav_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"isaacgymenvs-lite\[video\]"):
        save_video(tmp_path / "square.mp4", pictures(1), 25.0)
