"""Which checkout a task file belongs to, and where its clips and models may be."""

from __future__ import annotations

from pathlib import Path

from isaacgymenvs_lite.config.staging import (
    _task_of_ase_file,
    _train_file_beside,
    checkout_of,
    clip_folders,
    model_folders,
)


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def test_the_checkout_by_its_layout(tmp_path: Path) -> None:
    for file, top, checkout in [
        ("fork/isaacgymenvs/cfg/task/A.yaml", "fork/setup.py", "fork"),
        ("fork/isaacgymenvs/cfg/task/A.yaml", "fork/assets/x", "fork"),
        # the package brings its own assets: the folder above may be anybody's
        ("home/isaacgymenvs/cfg/task/A.yaml", "home/isaacgymenvs/assets/x", "home/isaacgymenvs"),
        ("home/isaacgymenvs/cfg/task/A.yaml", "home/else", "home/isaacgymenvs"),
        # without a package; what is above it does not belong to it
        ("fork/cfg/task/A.yaml", "fork/pyproject.toml", "fork"),
        ("fork/ase/data/cfg/humanoid.yaml", "fork/README.md", "fork"),
        ("home/A.yaml", "home/assets/x", "home"),
        ("fork/task/A.yaml", "fork/setup.py", "fork/task"),
    ]:
        _made(tmp_path / top)
        assert checkout_of(_made(tmp_path / file)) == tmp_path / checkout


def test_clips_by_name_or_by_path_below_the_checkout(tmp_path: Path) -> None:
    _made(tmp_path / "ase/data/cfg/humanoid.yaml")
    folders = [tmp_path, tmp_path / "assets/amp/motions", tmp_path / "ase/data/motions"]
    assert clip_folders(tmp_path, "run.npy") == folders
    assert clip_folders(tmp_path, "../run.npy") == []


def test_models_below_the_root_that_the_file_names(tmp_path: Path) -> None:
    assert model_folders(tmp_path, "") == [tmp_path / "assets"]
    assert model_folders(tmp_path, "../../robots") == [tmp_path / "robots", tmp_path / "assets"]
    assert model_folders(tmp_path, "/elsewhere") == [tmp_path / "assets"]


def test_the_train_file_of_a_task_file(tmp_path: Path) -> None:
    task = _made(tmp_path / "cfg/task/Mine.yaml")
    assert _train_file_beside(task) is None
    train = _made(tmp_path / "cfg/train/MinePPO.yaml")
    assert _train_file_beside(task) == train
    # Not of a file that merely lies somewhere.
    assert _train_file_beside(_made(tmp_path / "cfg/other/Mine.yaml")) is None


def test_tasks_of_ases_files_by_their_names() -> None:
    folder = Path("/ase/ase/data/cfg")
    found = {
        name: _task_of_ase_file(folder / f"{name}.yaml")
        for name in ("humanoid", "humanoid_sword_shield_strike", "humanoid_ase_getup")
    }
    assert list(found.values()) == ["HumanoidASE", "HumanoidStrike", "HumanoidASEGetup"]
    assert _task_of_ase_file(Path("/fork/cfg/task/humanoid.yaml")) is None
