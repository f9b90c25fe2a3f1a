"""The command that a policy starts again with."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from isaacgymenvs_lite.pbt import restart
from isaacgymenvs_lite.pbt.restart import RestartRequest, start_again
from tests.train_command import make_train_command

GAMMA = "train.params.config.gamma"
CHANGED = {
    GAMMA: 0.987654321,
    "train.params.config.learning_rate": 1e-05,
    "train.params.config.mini_epochs": 3,
    "checkpoint": "/a b/run=1,[2]'s/resume/4.pth",
    "full_experiment_name": "amp/Ant_pbt_01_01-02-03-04",
    "pbt_restart": True,
}
REQUEST = RestartRequest(CHANGED, Path("runs/Ant"))
TYPED = ["task=Ant", f"{GAMMA}=0.9", "checkpoint=old.pth", "pbt=pbt_default", "pbt.policy_idx=1"]


class Replaced(BaseException):
    """What os.execv does not return from."""


@pytest.fixture
def commands(monkeypatch) -> list[list[str]]:
    """Commands that this process would have become."""
    found: list[list[str]] = []

    def execv(program: str, command: list[str]) -> None:
        assert program == command[0] == sys.executable
        found.append(command[1:])
        raise Replaced

    monkeypatch.setattr(restart.os, "execv", execv)
    return found


def become(monkeypatch, commands: list[list[str]], *command: str, typed: list[str]) -> list[str]:
    monkeypatch.setattr(sys, "orig_argv", ["python", *command])
    with pytest.raises(Replaced):
        start_again(REQUEST, typed)
    return commands[-1]


def test_processes_send_it_to_each_other():
    received = RestartRequest.of(json.loads(json.dumps(REQUEST.content)))
    assert received is not None
    assert received.words(["resume=last"]) == REQUEST.words(["resume=last"])


def test_the_program_stays(monkeypatch, commands):
    for program in [
        ["train.py"],
        ["-u", "-X", "dev", "train.py"],
        ["-m", "isaacgymenvs_lite.train"],
        ["/venv/bin/isaacgymenvs-lite-train"],
        ["-m", "isaacgymenvs_lite", "alias", "train.py"],
    ]:
        command = become(monkeypatch, commands, *program, *TYPED, typed=TYPED)
        assert command == [*program, *REQUEST.words(TYPED)]


@pytest.fixture
def call(monkeypatch, tmp_path):
    def run(cfg: Any, command: Any) -> None:
        raise REQUEST

    return make_train_command(monkeypatch, tmp_path, run)


def test_train_py_carries_it_out(call, commands, monkeypatch):
    monkeypatch.setattr(sys, "orig_argv", ["python", "train.py", "task=Ant", "seed=3"])
    with pytest.raises(Replaced):
        call("task=Ant", "seed=3")
    assert commands == [["train.py", "task=Ant", "seed=3", *REQUEST.overrides]]
