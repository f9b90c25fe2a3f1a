"""Published tasks that are not here: what is said about them."""

from __future__ import annotations

import subprocess
import sys

import pytest

import isaacgymenvs_lite
from isaacgymenvs_lite.config import published_names
from isaacgymenvs_lite.config.compose import compose, compose_task
from isaacgymenvs_lite.config.published_names import (
    PUBLISHED_TASKS,
    missing_choice,
    missing_task,
    missing_task_of_file,
    task_in_name,
)
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.tasks import find_task

TASKS = {path.stem for path in (cfg_dir() / "task").glob("*.yaml")}


@pytest.mark.parametrize("name", sorted(set(PUBLISHED_TASKS) - TASKS))
def test_each_is_said_to_be_published(name: str) -> None:
    line = missing_task(name) or ""
    assert line.startswith(f"{name} is a published task (")
    assert "is not here yet; nearest to it: " in line
    assert set(PUBLISHED_TASKS[name].nearest) <= TASKS


def test_what_is_here_is_not_missing(monkeypatch) -> None:
    monkeypatch.setitem(PUBLISHED_TASKS, "Ant", PUBLISHED_TASKS["Trifinger"])
    assert missing_task("Ant") is None  # it has a task file by now
    assert missing_task("Cartpole") is None
    assert missing_choice("pbt", "pbt_default") is None


@pytest.mark.parametrize(
    ("stem", "task"),
    [
        ("FrankaCabinetPPO", "FrankaCabinet"),
        ("ShadowHandPPOAsymmLSTM", "ShadowHand"),
        ("ShadowHandOpenAI_FFPPO", "ShadowHandOpenAI_FF"),
        ("AllegroHandLSTM_BigPPO", "AllegroHandLSTM"),
        ("AllegroKukaTwoArmsLSTMPPO", "AllegroKukaTwoArmsLSTM"),
        ("FactoryTaskNutBoltPickPPO", "FactoryTaskNutBoltPick"),
        ("Trifingers", None),
        ("AntPPO", None),
    ],
)
def test_train_files_by_their_names(stem: str, task: str | None) -> None:
    assert missing_task_of_file(stem) == task


@pytest.mark.parametrize(
    ("stem", "task"),
    [("MyRobotPPO", "MyRobot"), ("MyRobotPPO_LSTM", "MyRobot"), ("XSAC", "X"), ("mine", "mine")],
)
def test_the_task_in_a_train_files_name(stem: str, task: str) -> None:
    assert task_in_name(stem) == task


SAID = "ShadowHand is a published task .* not here yet; nearest to it: BallBalance"


def test_every_way_in_says_it() -> None:
    with pytest.raises(ConfigError, match=f"{SAID}; choices: Ant, "):
        compose(["task=ShadowHand"])
    with pytest.raises(ConfigError, match=SAID):
        compose_task("ShadowHand")
    with pytest.raises(ConfigError, match=SAID):
        isaacgymenvs_lite.make(task="ShadowHand", num_envs=2)
    with pytest.raises(ConfigError, match=f"task.name: {SAID}; your own: "):
        find_task("ShadowHand")
    with pytest.raises(ConfigError, match=f"train=ShadowHandPPOLSTM: {SAID}"):
        compose(["task=Ant", "train=ShadowHandPPOLSTM"])


def test_names_of_nobody_are_unknown_as_before() -> None:
    with pytest.raises(ConfigError, match="unknown task 'ShadowHands'; choices"):
        compose(["task=ShadowHands"])
    with pytest.raises(ConfigError, match="unknown pbt 'other'"):
        compose(["task=Ant", "pbt=other"])


def test_the_list_needs_no_torch() -> None:
    code = f"import sys, {published_names.__name__}; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
