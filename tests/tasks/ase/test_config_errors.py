"""Mistakes in `task.env` of ASE's tasks: one line that names the key, the value and the choices."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from isaacgymenvs_lite.errors import ConfigError, MotionFileError
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
        "task.env.goal: got 'dance', expected one of heading, location, reach, strike, skill, none"
    )


def test_empty_ranges(message) -> None:
    for goal, low, high, equal in [
        ("heading", ("tarSpeedMin", 2), ("tarSpeedMax", 1), "at most"),
        ("heading", ("headingChangeStepsMin", 50), ("headingChangeStepsMax", 50), "less than"),
        ("location", ("tarChangeStepsMin", 7), ("tarChangeStepsMax", 7), "less than"),
        ("reach", ("tarChangeStepsMin", 9), ("tarChangeStepsMax", 8), "less than"),
        ("reach", ("tarHeightMin", 1.5), ("tarHeightMax", 1.4), "at most"),
    ]:
        assert message(goal=goal, **dict((low, high))) == (
            f"task.env.{low[0]}={low[1]} and task.env.{high[0]}={high[1]}:"
            f" expected {low[0]} to be {equal} {high[0]}"
        )


# --- bodies -----------------------------------------------------------------------------------


def test_a_body_that_does_not_exist(message) -> None:
    for settings, key in [
        ({"keyBodies": ["right_hnd"]}, "keyBodies"),
        ({"contactBodies": ["left_foot", "right_hnd"]}, "contactBodies"),
        ({"goal": "strike", "strikeBodyNames": ["right_hnd"]}, "strikeBodyNames"),
        ({"goal": "reach", "reachBodyName": "right_hnd"}, "reachBodyName"),
    ]:
        found = message(**settings)
        assert re.search(rf"task\.env\.{key}:? 'right_hnd' \(did you mean 'right_hand'\?\)", found)
        assert "choices: head, left_foot, left_hand," in found


# --- keys and values --------------------------------------------------------------------------


def test_values_out_of_range(message) -> None:
    for settings, expected in [
        ({"recoveryEpisodeProb": 1.5}, "a number of at least 0 and of at most 1"),
        ({"fallInitProb": -0.1}, "a number of at least 0 and of at most 1"),
        ({"recoverySteps": -1}, "a whole number of at least 0"),
        ({"numAMPObsSteps": 1}, "a whole number of at least 2 and of at most 1000"),
        ({"numAMPObsSteps": 2000}, "a whole number of at least 2 and of at most 1000"),
        ({"enableTaskObs": 3}, "True or False"),
        ({"stateInit": "Lying"}, "one of Default, Start, Random, Hybrid"),
    ]:
        ((key, value),) = settings.items()
        found = message(cls=HumanoidASEGetup, **settings)
        assert found == f"task.env.{key}: got {value!r}, expected {expected}"


# --- files ------------------------------------------------------------------------------------


def test_a_clip_of_another_skeleton(message, walk_clip: Path, armed_walk_clip: Path) -> None:
    found = message(MotionFileError, motion_file=str(armed_walk_clip))
    assert f"{armed_walk_clip}: its skeleton also has sword, shield; expected the 15" in found
    assert "task.env.asset.assetFileName=mjcf/amp_humanoid_sword_shield.xml" in found
    found = message(MotionFileError, armed=True, motion_file=str(walk_clip))
    assert f"{walk_clip}: its skeleton lacks sword, shield; expected the 17" in found
