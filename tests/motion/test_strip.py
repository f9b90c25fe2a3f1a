from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import PIL.Image
import pytest

from isaacgymenvs_lite.errors import ConfigError, MissingPackageError
from isaacgymenvs_lite.motion import strip
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.rendering.gl import RenderingError, ensure_gl
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.rendering.view import View


def test_missing_pillow_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"isaacgymenvs-lite\[video\]"):
        strip.save_strip(load_clips("walk")[0][0], tmp_path / "walk.png", 1.0)


def test_unknown_clip_is_one_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as exit_info:
        strip.main(["wlak", str(tmp_path / "out.png")])
    assert exit_info.value.code == 2
    message = capsys.readouterr().err
    assert "'wlak' not found" in message
    assert message.count("\n") == 1


def test_an_unknown_key_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as exit_info:
        strip.main(["walk", str(tmp_path / "out.png"), "frame=2"])
    assert exit_info.value.code == 2
    assert "unknown key 'frame' (did you mean 'frames'?)" in capsys.readouterr().err


def test_strip_shows_poses_side_by_side(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without a renderer: each pose is a grey panel, as bright as its root is far."""

    def draw(model: mujoco.MjModel, qpos: np.ndarray, view: View) -> Image:
        panels = [np.full((4, 3, 3), 100 * x, np.uint8) for x in qpos[:, 0] - qpos[0, 0]]
        return np.concatenate(panels, axis=1)

    monkeypatch.setattr(strip, "draw_poses", draw)
    clip = load_clips("walk")[0][0]
    path = strip.save_strip(clip, tmp_path / "walk.png", 0.9, num_frames=3)
    with PIL.Image.open(path) as image:
        shown = np.asarray(image.convert("L"))
    assert shown.shape == (4, 9)
    frames = [round(time_s * clip.fps) for time_s in (0.0, 0.3, 0.6)]
    away_m = clip.root_translation[frames, 0] - clip.root_translation[0, 0]
    np.testing.assert_array_equal(shown[0, ::3], (100 * away_m).astype(np.uint8))


def test_a_strip_is_drawn(tmp_path: Path) -> None:
    try:
        ensure_gl()
    except RenderingError as error:
        pytest.skip(str(error))
    keys, options = ["frames=2", "seconds=0.9"], ["--frames", "2", "--seconds=0.9"]
    assert strip.main(["walk", str(tmp_path / "walk.png"), *keys]) == 0
    with PIL.Image.open(tmp_path / "walk.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    # The command's older form means the same.
    assert strip.main(["walk", str(tmp_path / "same.png"), *options]) == 0
    assert (tmp_path / "same.png").read_bytes() == (tmp_path / "walk.png").read_bytes()
    assert pixels.shape == (320, 400, 3)
    assert pixels.mean() > 100
    assert (pixels[:, :200] != pixels[:, 200:]).any()


def test_a_picture_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot write the picture .*nowhere"):
        strip.save_png(tmp_path / "nowhere" / "a.png", np.zeros((2, 2, 3), np.uint8))
