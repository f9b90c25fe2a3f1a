"""Goals are rewarded in addition to the motion style. The key `task.env.goal` selects one."""

from __future__ import annotations

from isaacgymenvs_lite.tasks.goals.goal import Goal
from isaacgymenvs_lite.tasks.goals.heading import Heading
from isaacgymenvs_lite.tasks.goals.location import Location
from isaacgymenvs_lite.tasks.goals.reach import Reach
from isaacgymenvs_lite.tasks.goals.skill import Skill
from isaacgymenvs_lite.tasks.goals.strike import Strike

GOALS: dict[str, type[Goal]] = {
    "heading": Heading,
    "location": Location,
    "reach": Reach,
    "strike": Strike,
    "skill": Skill,
    "none": Goal,
}
GOAL_NAMES = tuple(GOALS)


def goal_keys() -> frozenset[str]:
    """Return the keys of `task.env` that at least one goal reads."""
    return frozenset[str]().union(*(goal.keys() for goal in GOALS.values()))
