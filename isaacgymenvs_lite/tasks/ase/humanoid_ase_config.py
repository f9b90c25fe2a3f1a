"""The keys of cfg/task/HumanoidASE.yaml, `task.env`, beyond those of HumanoidAMP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.schema import keys_of, read_section, setting
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import HumanoidAMPConfig
from isaacgymenvs_lite.tasks.base.task_config import UNREAD_ENV_KEYS
from isaacgymenvs_lite.tasks.goals import GOAL_NAMES, goal_keys


@dataclass(frozen=True, kw_only=True)
class HumanoidASEConfig(HumanoidAMPConfig):
    """`task.env` of HumanoidASE; defaults as ASE's files for pre-training."""

    state_init: str = setting(
        "Hybrid", key="stateInit", choices=("Default", "Start", "Random", "Hybrid")
    )
    num_amp_obs_steps: int = setting(10, key="numAMPObsSteps", minimum=2, maximum=1000)
    local_root_obs: bool = setting(True, key="localRootObs")
    """In the AMP observation: take the heading out of the root's rotation. In the policy's the
    opposite: keep it there (ASE's files and checkpoints rely on that)."""
    root_height_obs: bool = setting(True, key="rootHeightObs")
    """False gives 0 for the height of the root in observations."""
    key_bodies: tuple[str, ...] = setting(
        ("right_hand", "left_hand", "right_foot", "left_foot"), key="keyBodies", min_length=1
    )
    """Bodies whose positions are in the AMP observation."""
    termination_height: float = setting(0.15, key="terminationHeight")
    """An episode ends when a touched character has a body below this height (m), or its head below
    0.3 m, or the arm with the shield below 0.32 m."""
    motion_file: str = setting("locomotion.yaml")
    goal: str = setting("none", choices=GOAL_NAMES)
    """The goal of the character, which the last entries of the observation describe."""


@dataclass(frozen=True, kw_only=True)
class GetupConfig(HumanoidASEConfig):
    """`task.env` of HumanoidASEGetup."""

    recovery_episode_prob: float = setting(0.2, key="recoveryEpisodeProb", minimum=0, maximum=1)
    """Share of the falls after which the character gets up from where it lies."""
    recovery_steps: int = setting(60, key="recoverySteps", minimum=0)
    """Control steps in which lying on the ground ends no episode."""
    fall_init_prob: float = setting(0.1, key="fallInitProb", minimum=0, maximum=1)
    """Share of the other episodes that start lying."""


def read_ase_config(
    env: dict[str, Any], cls: type[HumanoidASEConfig] = HumanoidASEConfig
) -> HumanoidASEConfig:
    """Check `task.env` of a task of ASE; the goal reads its own keys.

    Raises:
        ConfigError: an unknown, ill-typed or impossible value.
    """
    getup = keys_of(GetupConfig) - keys_of(cls)
    return read_section(cls, env, "task.env", ignored=(*UNREAD_ENV_KEYS, *goal_keys(), *getup))
