"""Pictures of trainings that are kept as measurements."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.attempts import draw, read_attempts
from isaacgymenvs_lite.errors import ConfigError

COLUMNS = ["frames", "episode_steps", "pose_error_m", "tempo", "motion_shown", "no_fall_share"]


def test_the_kept_attempts_can_be_read():
    attempts = read_attempts()
    assert len(attempts) > 30
    back_flip = attempts["flipB_s1"][-1]
    assert back_flip["no_fall_share"] == pytest.approx(15 / 16, abs=1e-3)
    assert back_flip["pose_error_m"] < 0.15  # the paper's


def test_measurements_without_a_number_are_left_out(tmp_path: Path):
    points = [[1e6, 20.0, 0.2, 0.5, None, 0.0], [2e6, 30.0, 0.1, 0.5, 0.3, 0.0]]
    line = {"run": "one", "columns": COLUMNS, "points": points}
    file = tmp_path / "attempts.jsonl"
    file.write_text(json.dumps(line) + "\n")
    (row,) = read_attempts(file)["one"]
    assert row["frames"] == 2e6


def test_a_picture(tmp_path: Path):
    pytest.importorskip("matplotlib")
    out = tmp_path / "curves.png"
    draw({"flipB_s1": "good", "flip_dev2_s1": "stands"}, out)
    assert out.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match="unknown run 'flipb_s1'"):
        draw({"flipb_s1": "?"}, out)
