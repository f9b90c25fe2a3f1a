"""HumanoidASE: the humanoid of ASE learns skills from many clips and uses them for goals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.schema import keys_of, read_section, setting
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import CharacterState, HumanoidAMPConfig
from isaacgymenvs_lite.tasks.base.humanoid_observations import (
    all_body_observation_groups,
    compute_all_body_observations,
    pd_action_offset_scale,
)
from isaacgymenvs_lite.tasks.base.task_config import UNREAD_ENV_KEYS
from isaacgymenvs_lite.tasks.goals import (
    GOAL_NAMES,
    GOALS,
    Goal,
    Heading,
    Location,
    Reach,
    Strike,
    goal_keys,
)


@dataclass(frozen=True, kw_only=True)
class HumanoidASEConfig(HumanoidAMPConfig):
    """`task.env` of HumanoidASE, with the defaults of ASE's files for pre-training."""

    state_init: str = setting(
        "Hybrid", key="stateInit", choices=("Default", "Start", "Random", "Hybrid")
    )
    num_amp_obs_steps: int = setting(10, key="numAMPObsSteps", minimum=2, maximum=1000)
    local_root_obs: bool = setting(True, key="localRootObs")
    """If True, the AMP observation excludes the heading from the root rotation, and the policy
    observation includes it. ASE's files and checkpoints rely on this difference."""
    root_height_obs: bool = setting(True, key="rootHeightObs")  # False: observe 0 instead
    key_bodies: tuple[str, ...] = setting(
        ("right_hand", "left_hand", "right_foot", "left_foot"), key="keyBodies", min_length=1
    )
    termination_height: float = setting(0.15, key="terminationHeight")
    motion_file: str = setting("locomotion.yaml")
    goal: str = setting("none", choices=GOAL_NAMES)


@dataclass(frozen=True, kw_only=True)
class GetupConfig(HumanoidASEConfig):
    """`task.env` of HumanoidASEGetup."""

    recovery_episode_prob: float = setting(0.2, key="recoveryEpisodeProb", minimum=0, maximum=1)
    recovery_steps: int = setting(60, key="recoverySteps", minimum=0)
    fall_init_prob: float = setting(0.1, key="fallInitProb", minimum=0, maximum=1)


def read_ase_config(
    env: dict[str, Any], cls: type[HumanoidASEConfig] = HumanoidASEConfig, goal: type[Goal] = Goal
) -> HumanoidASEConfig:
    """Check and return the keys of `task.env`, except the keys of goals."""
    getup = keys_of(GetupConfig) - keys_of(cls)
    ignored = (*UNREAD_ENV_KEYS, *goal_keys(), *goal.keys(), *getup)
    return read_section(cls, env, "task.env", ignored=ignored)


# This file has ASE's drives, and `amp_humanoid.xml` has IsaacGymEnvs' drives.
_ASSET_OF_DRIVES = "mjcf/amp_humanoid_sword_shield.xml"
HEAD = "head"
# These bodies have larger termination heights (m) than all other bodies.
_HIGH_BODIES = {HEAD: 0.3}
_HIGH_BODIES_WITH_SHIELD = {"left_lower_arm": 0.32}


def copy_drives(source: mujoco.MjSpec, spec: mujoco.MjSpec) -> None:
    """Copy gains, efforts and armatures between actuators and joints of the same names."""
    drives = {actuator.name: actuator for actuator in source.actuators}
    joints = {joint.name: joint for joint in source.joints}
    for actuator in spec.actuators:
        if actuator.name in drives:
            drive = drives[actuator.name]
            actuator.gainprm, actuator.biasprm = drive.gainprm, drive.biasprm
            actuator.forcerange = drive.forcerange
    for joint in spec.joints:
        if joint.name in joints:
            joint.armature = joints[joint.name].armature


class HumanoidASE(HumanoidAMP):
    """HumanoidAMP with the conventions of the ASE release and with a goal.

    The key `task.env.goal` names the goal. A subclass with a `goal_class` has only this goal.

    HumanoidASE differs from HumanoidAMP in these points:

    - The policy observes all bodies and the goal.
    - The AMP observation encodes hinges as rotations.
    - The drives are stiffer, and targets of ball joints reach 1.2 times their limits.
    - A character whose head is below 0.3 m counts as fallen.

    Another asset is the humanoid with sword and shield, which has 31 degrees of freedom.
    """

    amp_obs_as_ase = True
    num_dofs_of_assets = (28, 31)
    settings_class: ClassVar[type[HumanoidASEConfig]] = HumanoidASEConfig
    env_cfg: HumanoidASEConfig

    def read_settings(self, env: dict[str, Any]) -> HumanoidASEConfig:
        """Check `task.env` and create the goal. Raise ConfigError for the goal of another task."""
        config = read_ase_config(env, self.settings_class, self.goal_class)
        own = next((name for name, goal in GOALS.items() if goal is self.goal_class), None)
        if own not in (None, "none", env.get("goal", own)):
            raise ConfigError(
                f"task.env.goal={config.goal}: {type(self).__name__} requires the goal"
                f" '{own}'; use task=HumanoidASE for other goals"
            )
        goal_class = GOALS[config.goal] if self.goal_class is Goal else self.goal_class
        self.goal = goal_class(env)
        return config

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Set ASE's drives and add the objects of the goal."""
        copy_drives(mujoco.MjSpec.from_file(str(assets_dir() / _ASSET_OF_DRIVES)), spec)
        super().change_spec(spec)

    def character_observation_groups(self) -> dict[str, int]:
        """See `compute_all_body_observations`."""
        return all_body_observation_groups(len(self._layout.body_names))

    def observation_frames(self) -> dict[str, str]:
        """Return the frames of the parts of `compute_all_body_observations`."""
        vectors = ("body_pos", "body_lin_vel", "body_ang_vel")
        return {"root_height": "world", **dict.fromkeys(vectors, "heading")}

    def key_body_names(self) -> tuple[str, ...]:
        """Return the bodies whose positions are in the AMP observation."""
        return self.env_cfg.key_bodies

    def _pd_offset_scale(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        return pd_action_offset_scale(lower, upper, self._layout.dof_offsets, as_ase=True)

    def _termination_heights(self) -> Tensor:
        names = self.simulation.body_names
        high = _HIGH_BODIES | (_HIGH_BODIES_WITH_SHIELD if "shield" in names else {})
        lowest = self.env_cfg.termination_height
        heights = [max(lowest, high.get(name, lowest)) for name in names]
        return torch.tensor(heights, device=self.device)

    def _observe_character(self, env_ids: Tensor | None) -> Tensor:
        sim = self.simulation
        bodies = [sim.body_pos, sim.body_rot, sim.body_lin_vel, sim.body_ang_vel]
        if env_ids is not None:
            bodies = [values.index_select(0, env_ids) for values in bodies]
        pos, rot, lin_vel, ang_vel = bodies
        return compute_all_body_observations(
            pos, rot, lin_vel, ang_vel, self.env_cfg.local_root_obs, self.env_cfg.root_height_obs
        )

    def _observe_clip(self, states: CharacterState) -> Tensor | None:
        """Return observations of all bodies, with body motions that the simulation computes."""
        root_states, dof_pos, dof_vel, _ = states
        observations = []
        for rows in torch.arange(len(root_states), device=self.device).split(self.num_envs):
            env_ids = torch.arange(len(rows), device=self.device)
            self.simulation.write_state(env_ids, root_states[rows], dof_pos[rows], dof_vel[rows])
            observations.append(self._observe_character(env_ids))
        return torch.cat(observations)

    def _amp_features(self, state: CharacterState) -> Tensor:
        features = super()._amp_features(state)
        if not self.env_cfg.root_height_obs:
            features[:, 0] = 0.0
        return features

    def current_amp_features(self, env_ids: Tensor | None = None) -> Tensor:
        """Return one step of the AMP observation in ASE's encoding."""
        return self._amp_features(self._character_states(env_ids))


class HumanoidHeading(HumanoidASE):
    """HumanoidASE with the goal `heading`."""

    goal_class = Heading


class HumanoidLocation(HumanoidASE):
    """HumanoidASE with the goal `location`."""

    goal_class = Location


class HumanoidReach(HumanoidASE):
    """HumanoidASE with the goal `reach`."""

    goal_class = Reach


class HumanoidStrike(HumanoidASE):
    """HumanoidASE with the goal `strike`."""

    goal_class = Strike
