from __future__ import annotations

from pathlib import Path

import av
import mujoco
import numpy as np
import PIL.Image
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion import strip, view
from isaacgymenvs_lite.rendering.gl import RenderingError, ensure_gl


@pytest.mark.slow
@pytest.mark.usefixtures("gl")
def test_a_clip_becomes_a_video_without_a_display(walk_clip, tmp_path, monkeypatch):
    monkeypatch.setattr(view, "WIDTH", 120)
    monkeypatch.setattr(view, "HEIGHT", 120)
    out = tmp_path / "walk.mp4"
    assert view.main([str(walk_clip), f"out={out}", "seconds=2"]) == 0
    with av.open(str(out)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 30
    assert len(frames) == 60  # the clip has 46: it goes on from its start
    assert frames[0].mean() > 60
    assert (np.abs(frames[10].astype(int) - frames[0]) > 30).mean() > 0.001


def test_a_clip_of_the_armed_humanoid_is_shown_on_it(armed_walk_clip, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(view, "draw_tracks", lambda model, *_, **__: shown.append(model) or [])
    monkeypatch.setattr(view, "save_video", lambda out, *_: out)
    assert view.main([str(armed_walk_clip), f"out={tmp_path / 'walk.mp4'}"]) == 0
    assert mujoco.mj_name2id(shown[0], mujoco.mjtObj.mjOBJ_BODY, "sword") > 0


def test_without_out_a_display_is_needed(walk_clip, monkeypatch, capsys):
    def refuse(setting: str, instead: str) -> None:
        raise ConfigError(f"{setting}: no display; {instead}")

    monkeypatch.setattr(view, "check_display", refuse)
    with pytest.raises(SystemExit) as stop:
        view.main([str(walk_clip)])
    assert stop.value.code == 2
    assert "out=FILE.mp4" in capsys.readouterr().err


def test_mistakes_are_one_line(tmp_path, monkeypatch, capsys):
    for words in (
        ["wlak", "out=x.mp4"],
        ["walk", "out=x.avi"],
        ["walk", "ot=x"],
        ["locomotion", "out=x.mp4"],
    ):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(SystemExit) as stop:
            view.main(words)
        assert stop.value.code == 2
        error = capsys.readouterr().err.strip()
        assert error.startswith("error: ")
        assert "\n" not in error


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
