"""Explains names that IsaacGymEnvs and ASE published and that are not here.

`task=ShadowHand` is not a misspelt name. A message about such a name explains what it is, and which
tasks of this project are nearest to it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from isaacgymenvs_lite.paths import cfg_dir


@dataclass(frozen=True)
class PublishedName:
    """A task or another choice that was published and is not here.

    Attributes:
        what: a few words on it.
        nearest: tasks of this project that have most in common with it.
    """

    what: str
    nearest: tuple[str, ...] = ()


_HAND = "a hand that turns an object"
_KUKA = "a Kuka arm with an Allegro hand"
_FACTORY = "assembly with a Franka arm"
_MANIPULATION = ("BallBalance",)


def _named(names: Iterable[str], what: str, nearest: tuple[str, ...]) -> dict[str, PublishedName]:
    return dict.fromkeys(names, PublishedName(what, nearest))


PUBLISHED_TASKS: dict[str, PublishedName] = {
    **_named(
        (
            *("AllegroHand", "AllegroHandLSTM", "AllegroHandADR", "AllegroHandManualDR"),
            *("AllegroHandDextremeADR", "AllegroHandDextremeManualDR"),
            *("ShadowHand", "ShadowHandOpenAI_FF", "ShadowHandOpenAI_LSTM", "ShadowHandTest"),
        ),
        _HAND,
        _MANIPULATION,
    ),
    **_named(
        ("AllegroKuka", "AllegroKukaLSTM", "AllegroKukaTwoArms", "AllegroKukaTwoArmsLSTM"),
        _KUKA,
        _MANIPULATION,
    ),
    **_named(
        (
            *("FactoryBase", "FactoryEnvGears", "FactoryEnvInsertion", "FactoryEnvNutBolt"),
            *("FactoryTaskGears", "FactoryTaskInsertion", "FactoryTaskNutBoltPick"),
            *("FactoryTaskNutBoltPlace", "FactoryTaskNutBoltScrew"),
            *("IndustRealBase", "IndustRealEnvGears", "IndustRealEnvPegs"),
            *("IndustRealTaskGearsInsert", "IndustRealTaskPegsInsert"),
            *("AutoMateBase", "AutoMateEnv", "AutoMateTaskAssemble", "AutoMateTaskDisassemble"),
            *("TacSLBase", "TacSLEnvInsertion", "TacSLTaskInsertion"),
        ),
        _FACTORY,
        _MANIPULATION,
    ),
    "FrankaCabinet": PublishedName("a Franka arm that opens a drawer", _MANIPULATION),
    "FrankaCubeStack": PublishedName("a Franka arm that stacks cubes", _MANIPULATION),
    "Trifinger": PublishedName("three fingers that move a cube", _MANIPULATION),
    "HumanoidAMPGetup": PublishedName(
        "ASE's humanoid that gets up", ("HumanoidASEGetup", "HumanoidAMP")
    ),
}
"""Task -> what it is; a name that this project has by now does not count, see `missing_task`."""

_ALGORITHM = re.compile(r"(?:PPO|SAC)\w*$")


def missing_task(name: str) -> str | None:
    """Return a message about a published task that is not here; None for any other name.

    >>> missing_task("Trifinger")
    "Trifinger is a published task (three fingers that move a cube) that is not here yet; nearest \
to it: BallBalance"
    """
    published = PUBLISHED_TASKS.get(name)
    if published is None or (cfg_dir() / "task" / f"{name}.yaml").is_file():
        return None
    return (
        f"{name} is a published task ({published.what}) that is not here yet; nearest to it:"
        f" {', '.join(published.nearest)}"
    )


def missing_task_of_file(stem: str) -> str | None:
    """Return the published task, not here yet, that a train or task file belongs to, or None.

    Args:
        stem: name of the file: `ShadowHandPPOAsymmLSTM`.
    """
    name = longest_task(stem, PUBLISHED_TASKS)
    return name if name and missing_task(name) else None


def longest_task(stem: str, tasks: Iterable[str]) -> str | None:
    """Return the longest of `tasks` that a file's name begins with, as whole words, or None."""
    fitting = [name for name in tasks if _begins_with(stem, name)]
    return max(fitting, key=len, default=None)


def task_in_name(stem: str) -> str:
    """Return a train file's name without its algorithm: MyRobot of MyRobotPPO_LSTM."""
    return _ALGORITHM.sub("", stem).rstrip("_-")


def missing_choice(group: str, name: str) -> str | None:
    """Return a message about a published file of a configuration group that is not here, or None.

    Args:
        group: task or train.
        name: as typed: `ShadowHand`.
    """
    if group == "task":
        return missing_task(name)
    if group == "train" and (task := missing_task_of_file(name)):
        return f"train={name}: {missing_task(task)}"
    return None


def _begins_with(stem: str, name: str) -> bool:
    rest = stem.removeprefix(name)
    return stem.startswith(name) and not rest[:1].islower()
