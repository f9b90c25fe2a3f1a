from __future__ import annotations

import sys
import types
from typing import Any

import pytest

from isaacgymenvs_lite.config.launch import LaunchSettings
from isaacgymenvs_lite.run.wandb_observer import WandbObserver, log_video


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
