"""Run folders: one run in each, made again if deleted, and rescued to a private folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from isaacgymenvs_lite.checkpoints.files import load_checkpoint, resolve_checkpoint, save_checkpoint
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.run.folder import LOCK_FILE, FolderInUseError, RunFolder

OpenRun = Callable[..., RunFolder]


@pytest.fixture
def open_run(tmp_path: Path) -> Iterator[OpenRun]:
    """Return open(name, train_dir=tmp_path/runs, task=Ant), the folder of a run that trains."""
    with ExitStack() as opened:

        def make(name: str = "walk", train_dir: Path | None = None, task: str = "Ant") -> RunFolder:
            folder = opened.enter_context(RunFolder(train_dir or tmp_path / "runs", name))
            folder.create(OmegaConf.create({"task": {"name": task}}))
            return folder

        yield make


def test_runs_of_one_second_get_folders_of_their_own(tmp_path):
    """As seeds that a shell starts at once: all have chosen a name before one makes its folder."""
    folders = [RunFolder(tmp_path, "walk_22-10-00-00", is_exact=False) for _ in range(3)]
    with ExitStack() as opened:
        names = [opened.enter_context(folder).path.name for folder in folders]
        assert names == ["walk_22-10-00-00", "walk_22-10-00-00_2", "walk_22-10-00-00_3"]
        assert RunFolder(tmp_path, "walk_22-10-00-00", is_exact=False).name.endswith("_4")
    assert list(tmp_path.iterdir()) == []  # nothing was made in them


@pytest.fixture
def tmp_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in place of the system's temporary one."""
    folder = tmp_path / "system_tmp"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def save(folder: RunFolder, name: str = "walk", epoch: int = 1) -> Path | None:
    state: dict[str, Any] = {"model": {"weight": torch.ones(2)}, "epoch": epoch}
    return save_checkpoint(str(folder.checkpoints / name), state)


def break_checkpoints(folder: RunFolder) -> None:
    """Make nn/ a folder that cannot be written, for root too."""
    shutil.rmtree(folder.checkpoints)
    folder.checkpoints.write_text("a file")


# --- one run in each folder --------------------------------------------------------------------


def test_a_second_run_stops_with_one_line(open_run, tmp_path):
    first = open_run("amp/walk", task="Ant")
    with pytest.raises(FolderInUseError) as caught:
        open_run("amp/walk", task="Humanoid")
    message = str(caught.value)
    for words in (str(first.path), f"process {os.getpid()} on ", "experiment=NAME"):
        assert words in message
    assert "\n" not in message
    assert "Ant" in (first.path / "config.yaml").read_text()
    open_run("amp/run")  # beside it


def test_after_the_run_the_next_may_begin(tmp_path):
    for task in ("Ant", "Humanoid"):
        with RunFolder(tmp_path, "walk") as folder:
            folder.create(OmegaConf.create({"task": {"name": task}}))
            folder.begin()
        assert task in (folder.path / "config.yaml").read_text()
        assert {path.name for path in folder.path.iterdir()} == {"config.yaml", "nn", "summaries"}


# Another process that holds the lock, without the seconds of our imports.
_HOLDER = """
import fcntl, sys, time

file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
file.write("process 17 on node3")
file.flush()
print("locked", flush=True)
time.sleep(60)
"""


def test_a_killed_run_leaves_no_lock_and_its_half_files_are_removed(open_run, tmp_path):
    folder = tmp_path / "runs" / "walk"
    half = [folder / "nn" / ".walk.pth.17.partial", folder / ".config.yaml.17.partial"]
    own = [folder / "nn" / name for name in ("a.partial", ".b.partial", "walk.pth")]
    for file in (*half, *own):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("half")
    command = [sys.executable, "-c", _HOLDER, str(folder / LOCK_FILE)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"locked\n"
    with pytest.raises(FolderInUseError, match="process 17 on node3"):
        open_run()
    assert all(file.exists() for file in half)  # of the run that lives
    process.kill()
    process.wait()
    process.stdout.close()
    assert (folder / LOCK_FILE).exists()
    open_run()
    assert not any(file.exists() for file in half)
    assert all(file.exists() for file in own)


def test_a_folder_with_a_link_below_it_is_refused(open_run, tmp_path):
    """A stranger's: what is written and removed through it would be somewhere else."""
    names = ("nn", "resume", "summaries", "videos", "torchrun_job", "nn/walk.pth", LOCK_FILE)
    for number, name in enumerate(names):
        link, elsewhere = tmp_path / "runs" / str(number) / name, tmp_path / "elsewhere"
        link.parent.mkdir(parents=True)
        link.symlink_to(elsewhere)
        with pytest.raises(ConfigError, match=f"{link} is a link, "):
            open_run(str(number))
        assert not elsewhere.exists()
        elsewhere.mkdir()
        (elsewhere / ".other.pth.17.partial").write_text("half")
        with pytest.raises(ConfigError, match=f"{link} is a link, "):
            open_run(str(number))
        assert (elsewhere / ".other.pth.17.partial").exists()
        shutil.rmtree(elsewhere)


# --- made again --------------------------------------------------------------------------------


@pytest.mark.parametrize("deleted", [".", "..", "nn", "config.yaml"])
def test_what_is_deleted_is_made_again_at_the_next_save(deleted, open_run, tmp_path, caplog):
    folder = open_run()
    config = (folder.path / "config.yaml").read_text()
    for epoch in range(3):
        gone = folder.path / deleted
        gone.unlink() if gone.is_file() else shutil.rmtree(gone.resolve())
        assert save(folder, epoch=epoch) == folder.checkpoints / "walk.pth"
        assert load_checkpoint(folder.checkpoints / "walk.pth")["epoch"] == epoch
        assert (folder.path / "config.yaml").read_text() == config
    assert caplog.text.count("was restored") == (0 if deleted == "config.yaml" else 3)


# --- rescued -----------------------------------------------------------------------------------


def test_last_finds_what_was_rescued(open_run, tmp_dir, tmp_path, caplog):
    runs = tmp_path / "runs"
    folder = open_run("amp/walk")
    assert save(folder, epoch=1) is not None
    break_checkpoints(folder)
    rescued = save(folder, epoch=2)
    assert rescued is not None
    assert rescued.is_relative_to(tmp_dir)
    assert folder.newest_checkpoint() == rescued
    assert not folder.save_failed
    assert resolve_checkpoint("last", runs, "Ant") == str(rescued)
    assert f"checkpoint=last uses the rescued checkpoint {rescued}" in caplog.text
    with pytest.raises(CheckpointError, match="there are checkpoints of task=Ant"):
        resolve_checkpoint("last", runs, "Humanoid")
    # A newer one in the run folder wins.
    folder.checkpoints.unlink()
    assert save(folder, epoch=3) == folder.checkpoints / "walk.pth"
    os.utime(rescued, (0, 0))
    assert resolve_checkpoint("last", runs, "Ant") == str(folder.checkpoints / "walk.pth")


def _link(path: Path, others: Path) -> None:
    path.symlink_to(others)


def _open_to_all(path: Path, others: Path) -> None:
    path.mkdir()
    path.chmod(0o777)


def _file(path: Path, others: Path) -> None:
    path.write_text("taken")


def _of_another_user(path: Path, others: Path) -> None:
    path.mkdir(mode=0o700)
    try:
        os.chown(path, 12345, -1)
    except PermissionError:
        pytest.skip("only root may give a folder away")


@pytest.mark.parametrize("attack", [_link, _open_to_all, _file, _of_another_user])
def test_a_folder_that_an_attacker_made_before_is_not_used(attack, open_run, tmp_dir, tmp_path):
    others = tmp_path / "others"
    others.mkdir(mode=0o700)
    attack(tmp_dir / f"isaacgymenvs_lite_rescue-{os.getuid()}", others)
    folder = open_run()
    break_checkpoints(folder)
    assert save(folder) is None
    assert folder.save_failed
    assert list(others.iterdir()) == []
    assert folder.newest_checkpoint() is None


def test_what_an_attacker_planted_is_not_taken(tmp_dir, tmp_path, open_run):
    folder = open_run()
    break_checkpoints(folder)
    file = save(folder)
    assert file is not None
    (root,) = tmp_dir.iterdir()
    root.chmod(0o755)
    with pytest.raises(CheckpointError, match="no checkpoint"):
        resolve_checkpoint("last", tmp_path / "runs", "Ant")
    assert folder.newest_checkpoint() is None


def test_a_disk_that_is_full_in_the_middle(open_run, tmp_dir, monkeypatch):
    """Whole files before, rescued ones meanwhile, whole files again after."""
    folder = open_run()
    assert save(folder, "a", 1) == folder.checkpoints / "a.pth"
    opened = Path.open

    def full(self: Path, *args: Any, **kwargs: Any) -> Any:
        target = Path("/dev/full") if self.is_relative_to(folder.path) else self
        return opened(target, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", full)
        rescued = save(folder, "b", 2)
    assert rescued is not None
    assert load_checkpoint(rescued)["epoch"] == 2
    assert save(folder, "c", 3) == folder.checkpoints / "c.pth"
    assert sorted(path.name for path in folder.checkpoints.iterdir()) == ["a.pth", "c.pth"]
