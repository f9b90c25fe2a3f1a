from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from isaacgymenvs_lite.errors import ConfigError, MissingPackageError
from isaacgymenvs_lite.motion import strip
from isaacgymenvs_lite.rendering.gl import RenderingError, ensure_gl


def test_missing_pillow_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"isaacgymenvs-lite\[video\]"):
        strip.draw_strip("walk", str(tmp_path / "walk.png"), strip.StripSettings())


def test_an_unknown_key_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as exit_info:
        strip.main(["walk", str(tmp_path / "out.png"), "frame=2"])
    assert exit_info.value.code == 2
    assert "unknown key 'frame' (did you mean 'frames'?)" in capsys.readouterr().err


def test_a_strip_is_drawn(tmp_path: Path) -> None:
    try:
        ensure_gl()
    except RenderingError as error:
        pytest.skip(str(error))
    assert strip.main(["walk", str(tmp_path / "walk.png"), "frames=2", "seconds=0.9"]) == 0
    with PIL.Image.open(tmp_path / "walk.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape == (320, 400, 3)
    assert pixels.mean() > 100
    assert (pixels[:, :200] != pixels[:, 200:]).any()


def test_a_picture_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot write the picture .*nowhere"):
        strip.save_png(tmp_path / "nowhere" / "a.png", np.zeros((2, 2, 3), np.uint8))
