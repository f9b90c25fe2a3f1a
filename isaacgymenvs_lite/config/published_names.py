"""Explains tasks that IsaacGymEnvs and ASE published and that are not here."""

from __future__ import annotations

import re
from collections.abc import Iterable

from isaacgymenvs_lite.paths import cfg_dir

# Begin of a task's name -> what the task is.
_PUBLISHED = {
    "AllegroHand": "a hand that turns an object",
    "AllegroKuka": "a Kuka arm with an Allegro hand",
    "AutoMate": "assembly with a Franka arm",
    "Factory": "assembly with a Franka arm",
    "FrankaCabinet": "a Franka arm that opens a drawer",
    "FrankaCubeStack": "a Franka arm that stacks cubes",
    "HumanoidAMPGetup": "ASE's humanoid that gets up, here HumanoidASEGetup",
    "IndustReal": "assembly with a Franka arm",
    "ShadowHand": "a hand that turns an object",
    "TacSL": "assembly with a Franka arm",
    "Trifinger": "three fingers that move a cube",
}
_ALGORITHM = re.compile(r"(?:PPO|SAC)\w*$")


def missing_task(name: str) -> str | None:
    """Return a message about a published task that is not here; None for any other name.

    Args:
        name: of a task, or a file of the task: `ShadowHandPPOAsymmLSTM`.
    """
    if (cfg_dir() / "task" / f"{name}.yaml").is_file():
        return None
    family = next((known for known in _PUBLISHED if name.startswith(known)), None)
    if family is None:
        return None
    return f"{_ALGORITHM.sub('', name)} is a published task ({_PUBLISHED[family]}) that is not here"


def missing_choice(group: str, name: str) -> str | None:
    """Return a message about a published file of cfg/task or cfg/train that is not here, or None.

    Args:
        group: task or train.
        name: as typed: `ShadowHand`.
    """
    return missing_task(name) if group in ("task", "train") else None


def longest_task(stem: str, tasks: Iterable[str]) -> str | None:
    """Return the longest of `tasks` that a file's name begins with, as whole words, or None."""
    fitting = [
        name
        for name in tasks
        if stem.startswith(name) and not stem.removeprefix(name)[:1].islower()
    ]
    return max(fitting, key=len, default=None)


def task_in_name(stem: str) -> str:
    """Return a train file's name without its algorithm: MyRobot of MyRobotPPO_LSTM."""
    return _ALGORITHM.sub("", stem).rstrip("_-")
