"""Writing checkpoints: atomically, and elsewhere when the folder cannot be written."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
import textwrap
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.checkpoints import files as checkpoints


def state(seed: int = 0) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)
    return {
        "model": OrderedDict(weight=torch.rand(3, 2, generator=generator)),
        "epoch": seed,
        "optimizer": {"state": {0: {"step": torch.tensor(1.0)}}, "param_groups": [{"lr": 0.1}]},
        "last_mean_rewards": -1.0,
        "env_state": None,
    }


@pytest.fixture
def rescue_dir(tmp_path, monkeypatch) -> Path:
    """Where rescued checkpoints go instead of the system's temporary folder."""
    folder = tmp_path / "system_tmp"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def test_a_checkpoint_comes_back(tmp_path):
    checkpoints.save_checkpoint(str(tmp_path / "model"), state(3))
    assert [path.name for path in tmp_path.iterdir()] == ["model.pth"]
    loaded = checkpoints.load_checkpoint(tmp_path / "model.pth")
    assert torch.equal(loaded["model"]["weight"], state(3)["model"]["weight"])
    assert loaded["epoch"] == 3
    assert loaded["env_state"] is None
    assert loaded["optimizer"]["state"][0]["step"] == 1.0


class FailsHalfway:
    """Stands in for torch.save: writes half of the file, then fails."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def __call__(self, obj: Any, file: Any) -> None:
        file.write(b"PK half a checkpoint")
        file.flush()
        raise self.error


def test_a_failure_in_the_middle_leaves_the_old_file(tmp_path, monkeypatch):
    for error in [
        OSError(errno.ENOSPC, "No space left on device"),
        # what torch's zip writer makes of a failed write
        RuntimeError("[enforce fail at inline_container.cc:603] . unexpected pos 64 vs 0"),
    ]:
        path = tmp_path / "model.pth"
        checkpoints.write_atomically(path, state(1))
        old = path.read_bytes()
        with monkeypatch.context() as patch, pytest.raises(OSError):
            patch.setattr(torch, "save", FailsHalfway(error))
            checkpoints.write_atomically(path, state(2))
        assert path.read_bytes() == old
        assert [file.name for file in tmp_path.iterdir()] == ["model.pth"]


def test_a_folder_that_cannot_be_written_loses_nothing(tmp_path, rescue_dir, caplog):
    (tmp_path / "run_7").write_text("a file where the run folder should be")
    checkpoints.save_checkpoint(str(tmp_path / "run_7" / "nn" / "model"), state(5))
    (rescued,) = rescue_dir.rglob("*.pth")
    assert "run_7" in str(rescued)
    assert checkpoints.load_checkpoint(rescued)["epoch"] == 5
    (record,) = caplog.records
    assert record.levelname == "ERROR"
    for words in ("run_7", str(rescued), "training goes on"):
        assert words in record.getMessage()


def test_a_full_disk_is_rescued_elsewhere(tmp_path, rescue_dir, monkeypatch, caplog):
    run = tmp_path / "runs" / "walk" / "nn"
    run.mkdir(parents=True)
    real_save = torch.save

    def save(obj: Any, file: Any) -> None:
        if str(rescue_dir) not in str(file.name):
            raise OSError(errno.ENOSPC, "No space left on device")
        real_save(obj, file)

    monkeypatch.setattr(torch, "save", save)
    checkpoints.save_checkpoint(str(run / "model"), state(6))
    (rescued,) = rescue_dir.rglob("*.pth")
    assert checkpoints.load_checkpoint(rescued)["epoch"] == 6
    assert "No space left" in caplog.text
    assert list(run.iterdir()) == []


def test_training_goes_on_when_nothing_can_be_written(tmp_path, rescue_dir, monkeypatch, caplog):
    monkeypatch.setattr(torch, "save", FailsHalfway(OSError(errno.ENOSPC, "No space left")))
    checkpoints.save_checkpoint(str(tmp_path / "model"), state())
    (record,) = caplog.records
    assert record.levelname == "ERROR"
    assert "No space left" in record.getMessage()
    assert not list(tmp_path.rglob("*.pth"))


def test_the_old_file_is_replaced_and_not_written_over(tmp_path):
    path = tmp_path / "model.pth"
    checkpoints.write_atomically(path, state(1))
    old = path.read_bytes()
    with path.open("rb") as before:  # a copy or a player that is reading it meanwhile
        checkpoints.write_atomically(path, state(2))
        assert before.read() == old
    assert checkpoints.load_checkpoint(path)["epoch"] == 2


_KILLED = """
import sys, torch
from pathlib import Path
from isaacgymenvs_lite.checkpoints import files as checkpoints

path = Path(sys.argv[1])
big = {"model": {"weight": torch.zeros(4_000_000)}, "epoch": 0}
checkpoints.write_atomically(path, big)
print("ready", flush=True)
while True:
    big["epoch"] += 1
    checkpoints.write_atomically(path, big)
"""


@pytest.mark.slow
def test_a_kill_leaves_a_whole_checkpoint(tmp_path):
    path = tmp_path / "model.pth"
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(_KILLED), str(path)], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    time.sleep(0.2)  # any moment will do: it writes all the time
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert checkpoints.load_checkpoint(path)["model"]["weight"].shape == (4_000_000,)


def test_numpy_scalars_become_numbers(tmp_path):
    given = {
        "model": {"weight": torch.ones(2)},
        "last_mean_rewards": np.float32(1.5),
        "epoch": np.int64(7),
        "best": np.bool_(True),
        "env_state": {"curriculum": [np.float64(0.25), (np.int32(3),)], "bins": np.arange(3.0)},
    }
    checkpoints.save_checkpoint(str(tmp_path / "model"), given)
    # nothing but torch's own safe loader is needed
    loaded = torch.load(tmp_path / "model.pth", weights_only=True)
    assert (loaded["last_mean_rewards"], loaded["epoch"], loaded["best"]) == (1.5, 7, True)
    assert loaded["env_state"]["curriculum"] == [0.25, (3,)]
    assert loaded["env_state"]["bins"].tolist() == [0.0, 1.0, 2.0]
    # and what was given is as it was
    assert type(given["last_mean_rewards"]) is np.float32
