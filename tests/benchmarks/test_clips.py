"""Tests the list of clips, the end of learned trainings, and the table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import clips, learning
from benchmarks.records import write_records
from isaacgymenvs_lite.errors import ConfigError
from tests.benchmarks.test_learned import GOOD, curve_of, of


def test_the_shipped_clips_without_data_sets():
    found = clips.named_clips(["shipped"])
    assert len(found) == 35
    assert found["walk"] == "walk"
    assert "locomotion" not in found


def test_a_folder_a_file_and_a_name(tmp_path: Path, walk_clip: Path):
    for name in ("hop.npz", "turn.csv", "notes.md"):
        (tmp_path / name).write_bytes(walk_clip.read_bytes())
    assert list(clips.named_clips([str(tmp_path)])) == ["hop", "turn"]
    assert clips.named_clips([str(walk_clip), "run"]) == {"walk": str(walk_clip), "run": "run"}
    with pytest.raises(ConfigError, match="have the same name"):
        clips.named_clips([str(walk_clip), "walk"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no clip in this folder"):
        clips.named_clips([str(tmp_path / "empty")])


def test_learned_clips_are_not_trained_again(tmp_path, monkeypatch):
    write_records([of("walk"), of("run", motion_shown=0.2)], tmp_path / "results" / "clips")
    words = ["clips", "--clips", "walk", "run", "--until-learned", "--resume"]
    folders = ["--runs-dir", str(tmp_path / "runs"), "--results-dir", str(tmp_path / "results")]
    trained = []
    monkeypatch.setattr(learning, "train_all", lambda todo, *_, **__: trained.extend(todo) or [])
    monkeypatch.setattr("sys.argv", ["learning", *words, *folders])
    learning.main()
    (job,) = trained
    assert (job.run.experiment, job.run.seed) == ("run", 1)
    assert job.is_over(curve_of(**GOOD, motion_shown=[0.1, 0.8, 0.9]))


def test_table(tmp_path, monkeypatch, capsys):
    for label, shown in (("walk", 0.9), ("run", 0.2)):
        early = of(label, frames=10, motion_shown=0.0)
        write_records([early, of(label, motion_shown=shown)], tmp_path)
    second = replace(of("run", pose_error_m=0.04), run="run_seed2", seed=2)
    write_records([second], tmp_path)
    words = ["--clips", "walk", "run", "jump", "--results-dir", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["clips", *words])
    clips.main()
    text = capsys.readouterr().out
    assert "| walk | 1.0 | 3 | 0.050 | 0.06 | 0.90 | 1.00 | 1.20 | yes |" in text
    of_both = "0.045 (0.040 to 0.050) | 0.06 | 0.55 (0.20 to 0.90) | 1.00 | 1.20 | 1 of 2 seeds |"
    assert f"| run | 1.0 | 3 | {of_both}" in text
    assert "| jump | | | | 0.06 | | | | not trained yet |" in text
    assert "1 of 2 clips are learned, 1 not done." in text
