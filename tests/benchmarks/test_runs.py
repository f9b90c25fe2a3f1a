from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.runs import Run, find_runs
from isaacgymenvs_lite.errors import CheckpointError


def make_run(folder: Path, seed: int = 42) -> Path:
    (folder / "nn").mkdir(parents=True)
    (folder / "config.yaml").write_text(f"seed: {seed}\n")
    return folder


def test_an_experiment_means_all_its_seeds_and_no_others(tmp_path):
    for name in ("walk_seed10", "walk_seed2", "walk+fp32_seed1", "walk_mocap_seed1", "walk_seedx"):
        make_run(tmp_path / name)
    assert [(run.experiment, run.seed) for run in find_runs("walk", tmp_path)] == [
        ("walk", 2),
        ("walk", 10),
    ]
    assert [run.folder.name for run in find_runs("walk+fp32", tmp_path)] == ["walk+fp32_seed1"]


def test_a_folder_means_itself(tmp_path):
    folder = make_run(tmp_path / "HumanoidAMP_21-09-28-03", seed=7)
    (run,) = find_runs(str(folder), tmp_path / "elsewhere")
    assert (run.experiment, run.seed, run.folder) == ("HumanoidAMP_21-09-28-03", 7, folder)
    (run,) = find_runs(str(make_run(tmp_path / "walk_seed3", seed=3)), tmp_path)
    assert run == Run.of(tmp_path, "walk", 3)


def test_checkpoint_of_an_epoch(tmp_path):
    run = Run.at(make_run(tmp_path / "walk_seed1"))
    for epoch in (5, 50, 500):
        (run.folder / "nn" / f"last_HumanoidAMP_ep_{epoch}_rew_1.5.pth").touch()
    assert run.checkpoint_of_epoch(50).name == "last_HumanoidAMP_ep_50_rew_1.5.pth"
    with pytest.raises(CheckpointError, match="no checkpoint of epoch 7"):
        run.checkpoint_of_epoch(7)
