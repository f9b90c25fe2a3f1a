from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion import strip
from isaacgymenvs_lite.motion.loader import load_clips


def test_missing_pillow_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"isaacgymenvs-lite\[docs\]"):
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


def test_strip_shows_poses_side_by_side(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without a renderer: the frames stand in for it."""
    image = pytest.importorskip("PIL.Image")
    shown: list[float] = []

    def frames(clip: object, times_s: np.ndarray, azimuth_deg: float) -> list[np.ndarray]:
        shown.extend(times_s)
        return [np.full((4, 3, 3), 10 * i, dtype=np.uint8) for i in range(len(times_s))]

    monkeypatch.setattr(strip, "render_frames", frames)
    path = strip.save_strip(load_clips("walk")[0][0], tmp_path / "walk.png", 0.9, num_frames=3)
    np.testing.assert_allclose(shown, (0.0, 0.3, 0.6))
    assert image.open(path).size == (9, 4)
