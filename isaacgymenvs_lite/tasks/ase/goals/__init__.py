"""The goals of ASE's tasks, by the name that `task.env.goal` gives."""

from __future__ import annotations

from isaacgymenvs_lite.tasks.ase.goals.goal import Goal
from isaacgymenvs_lite.tasks.ase.goals.heading import Heading
from isaacgymenvs_lite.tasks.ase.goals.location import Location
from isaacgymenvs_lite.tasks.ase.goals.reach import Reach
from isaacgymenvs_lite.tasks.ase.goals.strike import Strike

GOALS: dict[str, type[Goal]] = {
    "heading": Heading,
    "location": Location,
    "reach": Reach,
    "strike": Strike,
    "none": Goal,
}
GOAL_NAMES = tuple(GOALS)


def goal_keys() -> frozenset[str]:
    """Return the keys of `task.env` that some goal reads."""
    return frozenset[str]().union(*(goal.keys() for goal in GOALS.values()))
