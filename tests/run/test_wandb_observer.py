from __future__ import annotations

import os
import struct
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import isaacgymenvs_lite
from isaacgymenvs_lite.config.launch import LaunchSettings
from isaacgymenvs_lite.run.wandb_observer import WandbObserver, log_video
from tests.tiny import CONFIG, ONE_THREAD, TINY_SAC


class FakeWandb(types.ModuleType):
    """Fails `failures` times, then opens a run."""

    def __init__(self, failures: int) -> None:
        super().__init__("wandb")
        self.failures, self.inits, self.logged = failures, [], []
        self.finished = 0

    def init(self, **kwargs: Any) -> FakeWandb:
        self.inits.append(kwargs)
        if len(self.inits) <= self.failures:
            raise ConnectionError("no network")
        return self

    def log_code(self, root: str) -> None:
        self.logged.append(root)

    def finish(self) -> None:
        self.finished += 1
        if self.failures:
            raise ConnectionError("still no network")


@pytest.fixture
def open_wandb(monkeypatch):
    def run(failures: int, **changes: Any) -> FakeWandb:
        fake = FakeWandb(failures)
        monkeypatch.setitem(sys.modules, "wandb", fake)
        monkeypatch.setattr("isaacgymenvs_lite.run.wandb_observer.time.sleep", lambda s: None)
        settings = LaunchSettings(task_name="Ant", wandb_activate=True, **changes)
        train = {"params": {"config": {"name": "Ant"}}}
        tree = {"num_envs": 4, "twice": 4, "train": train}
        observer = WandbObserver(tree, settings, "Ant_01-02")
        observer.before_init("run", {}, "Ant_01-02")
        observer.close()
        observer.close()
        return fake

    return run


def test_a_wandb_run_mirrors_tensorboard(open_wandb):
    fake = open_wandb(0, wandb_project="p", wandb_group="", wandb_entity="me", wandb_tags=["a"])
    (given,) = fake.inits
    assert given["sync_tensorboard"] is True
    assert given["project"] == "p"
    assert given["entity"] == "me"
    assert given["group"] is None
    assert given["tags"] == ["a"]
    assert given["name"] == "Ant_01-02"
    assert given["config"]["twice"] == 4
    assert fake.logged == []
    assert fake.finished == 1


@pytest.mark.parametrize(("failures", "attempts"), [(2, 3), (99, 3)])
def test_wandb_failing_never_ends_a_training(failures, attempts, open_wandb, caplog):
    fake = open_wandb(failures)
    assert len(fake.inits) == attempts
    assert "no network" in caplog.text
    assert ("goes on without" in caplog.text) is (failures > attempts)
    assert ("could not be finished: still no network" in caplog.text) is (failures < attempts)


def test_a_video_goes_to_the_run(monkeypatch, tmp_path, caplog):
    fake: Any = FakeWandb(0)
    fake.Video = lambda path, format: (path, format)
    fake.run, fake.log = fake, fake.logged.append
    monkeypatch.setitem(sys.modules, "wandb", fake)
    log_video(tmp_path / "a.mp4")
    assert fake.logged == [{"video": (str(tmp_path / "a.mp4"), "mp4")}]

    def fail(*_: object) -> None:
        raise ConnectionError("no network")

    fake.log = fail
    log_video(tmp_path / "a.mp4")
    assert "no network" in caplog.text
    fake.run = None
    log_video(tmp_path / "a.mp4")  # the run could not be opened


# --- with the real library, without a network ---------------------------------------------------

TINY = {
    "Cartpole": (f"{CONFIG}.minibatch_size=64", f"{CONFIG}.horizon_length=8"),
    "AntSAC": TINY_SAC,
}
SCALARS = {
    "Cartpole": {"rewards/step", "info/last_lr", "info/fall_rate", "losses/a_loss"},
    "AntSAC": {"performance/step_inference_rl_update_fps", "performance/step_fps"},
}


def records(file: Path) -> Iterator[bytes]:
    """What a .wandb file holds: a LevelDB log of blocks of 32 KiB, after seven bytes of header."""
    data, position, part = file.read_bytes(), 7, b""
    while position + 7 <= len(data):
        left_in_block = 32768 - position % 32768
        if left_in_block < 7:
            position += left_in_block
            continue
        _, length, kind = struct.unpack("<IHB", data[position : position + 7])
        part += data[position + 7 : position + 7 + length]
        position += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield part
            part = b""


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(TINY))
def test_an_offline_run_has_the_scalars_of_the_training(task, tmp_path, monkeypatch):
    """A process of its own: wandb keeps a service and hooks into TensorBoard."""
    pytest.importorskip("wandb")
    from wandb.proto import wandb_internal_pb2

    train = Path(isaacgymenvs_lite.__file__).parents[1] / "train.py"
    words = ["num_envs=8", "max_iterations=4", *ONE_THREAD, *TINY[task]]
    keys = ["wandb_activate=True", "wandb_tags=[a,b]", "wandb_group=g", "wandb_project=p"]
    result = subprocess.run(
        [sys.executable, str(train), f"task={task}", *words, *keys, "wandb_name=mine"],
        cwd=tmp_path,
        env={**os.environ, "WANDB_MODE": "offline", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    (file,) = tmp_path.glob("wandb/offline-run-*/*.wandb")
    (run_folder,) = (tmp_path / "runs").iterdir()
    history: set[str] = set()
    runs = []
    for data in records(file):
        record: Any = wandb_internal_pb2.Record()  # type: ignore[attr-defined]
        record.ParseFromString(data)
        history |= {item.key or "/".join(item.nested_key) for item in record.history.item}
        if record.HasField("run"):
            runs.append(record.run)
    assert history >= SCALARS[task]
    run = runs[0]
    assert (run.project, run.run_group, list(run.tags)) == ("p", "g", ["a", "b"])
    assert (run.run_id, run.display_name) == (f"uid_{run_folder.name}", "mine")
    assert {"task", "train", "num_envs"} <= {update.key for update in run.config.update}
