"""Mistakes in `task.env` of ASE's tasks: one line that names the key, the value and the choices."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.tasks.ase.humanoid_ase import (
    HumanoidHeading,
    HumanoidLocation,
    HumanoidReach,
    HumanoidStrike,
)
from isaacgymenvs_lite.tasks.ase.humanoid_ase_getup import HumanoidASEGetup


@pytest.fixture
def message(make_ase):
    """Return `message(kind=ConfigError, **settings)`, what a task that cannot be made says."""

    def of(kind: type[Exception] = ConfigError, **settings) -> str:
        with pytest.raises(kind) as error:
            make_ase(1, **settings)
        assert "\n" not in str(error.value)
        return str(error.value)

    return of


# --- goals ------------------------------------------------------------------------------------


def test_a_goal_that_does_not_exist(message) -> None:
    assert message(goal="dance") == (
        "task.env.goal: got 'dance', expected one of heading, location, reach, strike, none"
    )


@pytest.mark.parametrize(
    ("cls", "own", "other"),
    [
        (HumanoidHeading, "heading", "location"),
        (HumanoidLocation, "location", "none"),
        (HumanoidReach, "reach", "strike"),
        (HumanoidStrike, "strike", "heading"),
    ],
)
def test_a_task_with_a_fixed_goal_takes_no_other(message, make_ase, cls, own, other) -> None:
    assert message(cls=cls, goal=other) == (
        f"task.env.goal={other}: {cls.__name__} has the goal '{own}'; task=HumanoidASE takes any"
    )
    # Its own may be repeated, as its task file does.
    assert type(make_ase(1, cls=cls, goal=own).goal) is type(make_ase(1, cls=cls).goal)


@pytest.mark.parametrize(
    ("goal", "low", "high", "equal"),
    [
        ("heading", ("tarSpeedMin", 2), ("tarSpeedMax", 1), "at most"),
        ("heading", ("headingChangeStepsMin", 50), ("headingChangeStepsMax", 50), "less than"),
        ("location", ("tarChangeStepsMin", 7), ("tarChangeStepsMax", 7), "less than"),
        ("reach", ("tarChangeStepsMin", 9), ("tarChangeStepsMax", 8), "less than"),
        ("reach", ("tarHeightMin", 1.5), ("tarHeightMax", 1.4), "at most"),
    ],
)
def test_empty_ranges(message, goal: str, low, high, equal: str) -> None:
    assert message(goal=goal, **dict((low, high))) == (
        f"task.env.{low[0]}={low[1]} and task.env.{high[0]}={high[1]}:"
        f" expected {low[0]} to be {equal} {high[0]}"
    )


def test_a_range_that_one_given_number_empties(message) -> None:
    # The other end is the goal's own.
    found = message(goal="reach", tarChangeStepsMin=100)
    assert "task.env.tarChangeStepsMax=100" in found


def test_speeds_and_heights_may_be_one_number(make_ase) -> None:
    make_ase(1, goal="heading", tarSpeedMin=2, tarSpeedMax=2)
    make_ase(1, goal="reach", tarHeightMin=1, tarHeightMax=1)


def test_settings_of_another_goal_are_not_read(make_ase, caplog) -> None:
    def course(**others) -> torch.Tensor:
        torch.manual_seed(0)
        task = make_ase(2, goal="location", **others)
        return torch.cat((task.reset()["obs"], task.step(task.zero_actions())[0]["obs"]))

    # One file has the keys of all goals; these would be errors for their own.
    others = {"tarSpeedMin": 2, "tarSpeedMax": 1, "reachBodyName": "tail", "tarHeightMin": 9}
    assert torch.equal(course(**others), course())
    assert not any("nothing reads" in message for message in caplog.messages)


# --- bodies -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"keyBodies": ["right_hnd"]}, "keyBodies"),
        ({"contactBodies": ["left_foot", "right_hnd"]}, "contactBodies"),
        ({"goal": "strike", "strikeBodyNames": ["right_hnd"]}, "strikeBodyNames"),
        ({"goal": "reach", "reachBodyName": "right_hnd"}, "reachBodyName"),
    ],
)
def test_a_body_that_does_not_exist(message, settings, key: str) -> None:
    found = message(**settings)
    assert re.search(rf"task\.env\.{key}:? 'right_hnd' \(did you mean 'right_hand'\?\)", found)
    assert "choices: head, left_foot, left_hand," in found


def test_the_sword_is_a_body_of_the_armed_humanoid_only(message, make_ase) -> None:
    assert "'sword'" in message(goal="reach", reachBodyName="sword")
    assert "'sword'" in message(keyBodies=["sword"])
    make_ase(1, armed=True, goal="reach", reachBodyName="sword")


# --- keys and values --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("tarSpedMin", "tarSpeedMin"),
        ("keyBodys", "keyBodies"),
        ("fallInitPrb", "fallInitProb"),
        ("strikeBodyName", "strikeBodyNames"),
    ],
)
def test_misspelt_keys(message, given: str, meant: str) -> None:
    assert message(**{given: 1}).startswith(
        f"unknown key 'task.env.{given}' (did you mean '{meant}'?)"
    )


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"recoveryEpisodeProb": 1.5}, "a number of at least 0 and of at most 1"),
        ({"fallInitProb": -0.1}, "a number of at least 0 and of at most 1"),
        ({"recoverySteps": -1}, "a whole number of at least 0"),
        ({"numAMPObsSteps": 1}, "a whole number of at least 2 and of at most 1000"),
        ({"numAMPObsSteps": 2000}, "a whole number of at least 2 and of at most 1000"),
        ({"enableTaskObs": 3}, "True or False"),
        ({"stateInit": "Lying"}, "one of Default, Start, Random, Hybrid"),
    ],
)
def test_values_out_of_range(message, settings, expected: str) -> None:
    ((key, value),) = settings.items()
    found = message(cls=HumanoidASEGetup, **settings)
    assert found == f"task.env.{key}: got {value!r}, expected {expected}"


def test_keys_of_getup_are_accepted_and_not_read_elsewhere(make_ase, hold_pose, caplog) -> None:
    getup = {"recoverySteps": 60, "recoveryEpisodeProb": 1.0, "fallInitProb": 1.0}
    task = make_ase(2, stateInit="Default", **getup)
    assert not any("nothing reads" in message for message in caplog.messages)
    standing = task.reset()["obs"]
    assert standing[:, 0].tolist() == pytest.approx([0.89] * 2)  # nobody starts on the ground
    sim = task.simulation
    root_states = sim.root_states.clone()
    root_states[:, 2] = 0.085
    root_states[:, 3:7] = torch.tensor([0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    sim.write_state(torch.arange(2), root_states, sim.dof_pos.clone(), sim.dof_vel.clone())
    actions = hold_pose(task)
    for _ in range(2):
        *_, dones, infos = task.step(actions)
    assert dones.tolist() == infos["terminate"].tolist() == [1, 1]  # no time to get up
    # Nobody goes on from where it lies.
    torch.testing.assert_close(task.reset_done()[0]["obs"], standing)


# --- files ------------------------------------------------------------------------------------


def test_an_asset_with_another_number_of_dofs(message, tmp_path: Path) -> None:
    path = tmp_path / "ball.xml"
    path.write_text(
        '<mujoco><worldbody><body name="b"><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    )
    found = message(asset={"assetFileName": str(path)})
    assert f"task.env.asset.assetFileName='{path}' has 0 degrees of freedom" in found
    assert "HumanoidASE expects 28 or 31 of both" in found
    assert "mjcf/amp_humanoid.xml, mjcf/amp_humanoid_sword_shield.xml" in found


def test_a_clip_of_another_skeleton(message, walk_clip: Path, armed_walk_clip: Path) -> None:
    found = message(MotionFileError, motion_file=str(armed_walk_clip))
    assert f"{armed_walk_clip}: its skeleton also has sword, shield; expected the 15" in found
    assert "task.env.asset.assetFileName=mjcf/amp_humanoid_sword_shield.xml" in found
    found = message(MotionFileError, armed=True, motion_file=str(walk_clip))
    assert f"{walk_clip}: its skeleton lacks sword, shield; expected the 17" in found
