"""Published tasks that are not here: what is said about them."""

from __future__ import annotations

import pytest

import isaacgymenvs_lite
from isaacgymenvs_lite.commands.check import longest_task, task_in_name
from isaacgymenvs_lite.config.compose import compose, compose_task, missing_task
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks import find_task


def test_published_tasks_and_their_files_are_explained() -> None:
    names = ("AllegroKukaTwoArmsLSTM", "FactoryTaskGearsPPO", "AllegroHandDextremeADR")
    assert all("is a published task (" in (missing_task(name) or "") for name in names)
    assert (missing_task("AllegroKukaPPOLSTM") or "").startswith("AllegroKuka is a published")
    here = ("Ant", "AntPPO", "ShadowHandPPOAsymm", "AllegroHandLSTM", "MyRobot")
    assert [missing_task(name) for name in here] == [None] * 5


def test_the_task_in_a_train_files_name() -> None:
    for stem, task in [
        ("MyRobotPPO", "MyRobot"),
        ("MyRobotPPO_LSTM", "MyRobot"),
        ("XSAC", "X"),
        ("mine", "mine"),
    ]:
        assert task_in_name(stem) == task
        assert longest_task(stem, ["My", "MyRobot", "X", "mine", "min"]) == task


SAID = "AllegroKuka is a published task .* that is not here"


def test_every_way_in_says_it() -> None:
    with pytest.raises(ConfigError, match=f"{SAID}; choices: AllegroHand, "):
        compose(["task=AllegroKuka"])
    with pytest.raises(ConfigError, match=SAID):
        compose_task("AllegroKuka")
    with pytest.raises(ConfigError, match=SAID):
        isaacgymenvs_lite.make(task="AllegroKuka", num_envs=2)
    with pytest.raises(ConfigError, match=f"task.name: {SAID}"):
        find_task("AllegroKuka")
    with pytest.raises(ConfigError, match=SAID):
        compose(["task=Ant", "train=AllegroKukaPPOLSTM"])


def test_names_of_nobody_are_unknown() -> None:
    with pytest.raises(ConfigError, match="unknown task 'Kukas'; choices"):
        compose(["task=Kukas"])
    with pytest.raises(ConfigError, match="unknown pbt 'other'"):
        compose(["task=Ant", "pbt=other"])
