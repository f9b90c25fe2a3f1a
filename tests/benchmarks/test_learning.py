from __future__ import annotations

import json
import os

import pytest

from benchmarks import learning
from benchmarks.learning import cpu_slots
from benchmarks.runs import Run


@pytest.fixture
def cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {7, 0, 1, 2, 3})


def test_places_share_no_cpu(cores):
    for parallel, per_run, expected in [
        (1, None, [[0, 1, 2, 3, 7]]),
        (2, None, [[0, 1], [2, 3]]),
        (5, None, [[0], [1], [2], [3], [7]]),
        (2, 1, [[0], [1]]),
    ]:
        assert cpu_slots(parallel, per_run) == expected


def test_mistakes_show_before_anything_starts(tmp_path, monkeypatch):
    for arguments, message in [
        (["wallk"], "error: unknown experiment 'wallk'"),
        (["num_envs=3"], "error: give an experiment"),
        (["walk_mocap"], "error: the experiment 'walk_mocap' needs its clip"),
        (["walk", "--motion-file", "x.npy"], "error: --motion-file has no effect"),
        (["walk", "--parallel", "999"], "error: --parallel 999"),
        (["clips", "walk"], "error: clips has separate folders"),
        (["walk", "--clips", "run"], "error: --clips has no effect"),
        (["clips", "--clips", "/nowhere/x"], "error: motion file '/nowhere/x' not found"),
    ]:
        monkeypatch.setattr(
            "sys.argv", ["learning", *arguments, "--runs-dir", str(tmp_path / "runs")]
        )
        with pytest.raises(SystemExit) as raised:
            learning.main()
        assert str(raised.value).startswith(message)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_train_resume_and_record(tmp_path, monkeypatch):
    """The real train.py is stopped by the clock, resumed, stopped, played and recorded."""
    words = ["walk", "num_envs=8", "rl_device=cpu", "--seeds", "4", "--cores-per-run", "1"]
    folders = ["--runs-dir", str(tmp_path / "runs"), "--results-dir", str(tmp_path / "results")]
    run = Run.of(tmp_path / "runs", "walk", 4)

    monkeypatch.setattr("sys.argv", ["learning", *words, *folders, "--minutes", "0.8"])
    learning.main()
    (first,) = map(json.loads, (tmp_path / "results" / "walk.jsonl").read_text().splitlines())
    assert first["frames"] > 0
    assert 0.0 < first["minutes"] < 0.9

    with pytest.raises(SystemExit, match="holds a training already"):
        learning.main()

    longer = ["learning", "--resume", *words, *folders, "--minutes", "1.6"]
    monkeypatch.setattr("sys.argv", longer)
    learning.main()
    rows = [json.loads(x) for x in (tmp_path / "results" / "walk.jsonl").read_text().splitlines()]
    assert [row["frames"] > first["frames"] for row in rows] == [False, True]
    assert first["minutes"] < rows[1]["minutes"] < 1.7
    assert len(run.starts()) == 2
    assert "resume=" in run.starts()[1].command

    learning.main()  # played again, not trained
    assert len(run.starts()) == 2


@pytest.mark.slow
def test_a_classic_task_is_recorded_by_its_return(tmp_path, monkeypatch, capsys):
    words = ["cartpole", "num_envs=8", "rl_device=cpu", "max_iterations=3", "--seeds", "1", "2"]
    folders = ["--runs-dir", str(tmp_path / "runs"), "--results-dir", str(tmp_path / "results")]
    monkeypatch.setattr("sys.argv", ["learning", *words, *folders, "--minutes", "5"])
    learning.main()
    rows = [json.loads(x) for x in (tmp_path / "results/cartpole.jsonl").read_text().splitlines()]
    assert [row["seed"] for row in rows] == [1, 2]
    assert all(-2.0 < row["episode_return"] <= row["steps"] for row in rows)
    assert "cartpole seed 2: return" in capsys.readouterr().out
