"""Keys, observations and rewards of AnymalTerrain, functions of named quantities. As IsaacGymEnvs.

The last dimension is N, the environments: (3, N), (12, N).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.velocity_tracking import (
    BaseMotion,
    CommandRangesConfig,
    ControlConfig,
    LearnConfig,
    VelocityTrackingConfig,
    compute_tracking_rewards,
    proprioception,
)
from isaacgymenvs_lite.tasks.terrain.grid import TerrainConfig
from isaacgymenvs_lite.tasks.terrain.height_scan import NUM_POINTS


@dataclass(frozen=True, kw_only=True)
class TerrainLearnConfig(LearnConfig):
    """`task.env.learn` of AnymalTerrain; rewards are per second, except for a fall's."""

    torque_reward: float = setting(-0.00002, key="torqueRewardScale")
    """Of the squared torques (Nm)."""
    lin_vel_z_reward: float = setting(-4.0, key="linearVelocityZRewardScale")
    """Of the squared vertical velocity (m/s)."""
    ang_vel_xy_reward: float = setting(-0.05, key="angularVelocityXYRewardScale")
    """Of the squared rates of roll and pitch (rad/s)."""
    orientation_reward: float = setting(0.0, key="orientationRewardScale")
    """Of the squared sine of the base's inclination."""
    base_height_reward: float = setting(0.0, key="baseHeightRewardScale")
    """Of the squared distance of the base from 0.52 m above the world's zero (m)."""
    joint_acc_reward: float = setting(-0.0005, key="jointAccRewardScale")
    """Of the squared changes of the joints' velocities (rad/s)."""
    knee_collision_reward: float = setting(-0.25, key="kneeCollisionRewardScale")
    """Of each knee that touches something."""
    stumble_reward: float = setting(0.0, key="feetStumbleRewardScale")
    """Of each foot that is held from the side."""
    action_rate_reward: float = setting(-0.01, key="actionRateRewardScale")
    """Of the squared changes of the actions."""
    air_time_reward: float = setting(1.0, key="feetAirTimeRewardScale")
    """Of the time that a landing foot was in the air, beyond 0.5 s."""
    hip_reward: float = setting(0.0, key="hipRewardScale")
    """Of the distances of the first joints of the legs from their default angles (rad)."""
    terminal_reward: float = setting(0.0, key="terminalReward")
    """Of a fall, once; per second as all others, so that -10 costs 0.2 (10 * 0.02 s)."""
    allow_knee_contacts: bool = setting(True, key="allowKneeContacts")
    """False: a knee that touches something ends the episode."""
    air_time_as_published: bool = setting(False, key="airTimeAsPublished")
    """This project's. True: a control step counts as one simulator call (0.005 s) in the air, so
    that a foot had to be there for 100 control steps, as in IsaacGymEnvs."""

    height_scale: float = setting(5.0, key="heightMeasurementScale")
    """Factor on heights."""
    add_noise: bool = setting(True, key="addNoise")
    noise_level: float = setting(1.0, key="noiseLevel", minimum=0)
    """Factor on all noise, which is uniform, in +- what follows."""
    dof_pos_noise: float = setting(0.01, key="dofPositionNoise", minimum=0)
    """rad."""
    dof_vel_noise: float = setting(1.5, key="dofVelocityNoise", minimum=0)
    """rad/s."""
    lin_vel_noise: float = setting(0.1, key="linearVelocityNoise", minimum=0)
    """m/s."""
    ang_vel_noise: float = setting(0.2, key="angularVelocityNoise", minimum=0)
    """rad/s."""
    gravity_noise: float = setting(0.05, key="gravityNoise", minimum=0)
    height_noise: float = setting(0.06, key="heightMeasurementNoise", minimum=0)
    """m."""

    randomize_friction: bool = setting(True, key="randomizeFriction")
    """Robots differ in their friction (there: always); False: all have the ground's."""
    friction_range: tuple[float, ...] = setting((0.5, 1.25), key="frictionRange", length=2)
    """Of the robots' own coefficients. A contact has the mean of it and the ground's, as PhysX."""
    push_robots: bool = setting(True, key="pushRobots")
    """False: no pushes. IsaacGymEnvs does not read the key and pushes always."""
    push_interval_s: float = setting(15.0, key="pushInterval_s", above=0)
    """From one push of all robots to the next."""
    episode_length_s: float = setting(20.0, key="episodeLength_s", above=0)


@dataclass(frozen=True, kw_only=True)
class TerrainControlConfig(ControlConfig):
    """`task.env.control` of AnymalTerrain."""

    stiffness: float = setting(80.0, minimum=0)
    """Nm/rad."""
    decimation: int = setting(4, minimum=1)
    """Simulator calls in a control step."""
    extra_call: bool = setting(False, key="extraSimulatorCall")
    """This project's. True: one more, which no length and no scale counts, as in IsaacGymEnvs."""


@dataclass(frozen=True, kw_only=True)
class HeadingCommandsConfig(CommandRangesConfig):
    """`task.env.randomCommandVelocityRanges` of AnymalTerrain: lowest and highest."""

    linear_x: tuple[float, ...] = setting((-1.0, 1.0), length=2)
    """m/s."""
    yaw: tuple[float, ...] = setting((-3.14, 3.14), length=2)
    """Of the heading (rad)."""


@dataclass(frozen=True, kw_only=True)
class AnymalTerrainConfig(VelocityTrackingConfig):
    """`task.env` of AnymalTerrain."""

    clip_actions: float = setting(float("inf"), key="clipActions", above=0)
    """Actions are clamped to this magnitude."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    command_ranges: HeadingCommandsConfig = field(
        default_factory=HeadingCommandsConfig, metadata={"key": "randomCommandVelocityRanges"}
    )
    control: TerrainControlConfig = field(default_factory=TerrainControlConfig)
    learn: TerrainLearnConfig = field(default_factory=TerrainLearnConfig)


# About the height of the base above its feet; heights are observed relative to it (m).
_STANDING_M = 0.5
_WANTED_HEIGHT_M = 0.52
_WANTED_AIR_TIME_S = 0.5
# Below this commanded speed (m/s) no air time is rewarded.
_WALKING_M_S = 0.1
_STUMBLE_SIDE_N, _STUMBLE_UP_N = 5.0, 1.0
TERM_NAMES = (
    "lin_vel_xy",
    "lin_vel_z",
    "ang_vel_z",
    "ang_vel_xy",
    "orient",
    "torques",
    "joint_acc",
    "base_height",
    "air_time",
    "collision",
    "stumble",
    "action_rate",
    "hip",
)
"""Of the reward, as IsaacGymEnvs logs them."""
# The joints that swing the legs to the side.
_HIPS = slice(0, 12, 3)


def noise_widths(cfg: TerrainLearnConfig) -> Tensor:
    """Return half the widths (188,) of the noise on observations, in their units."""
    parts = (
        (3, cfg.lin_vel_noise * cfg.lin_vel_scale),
        (3, cfg.ang_vel_noise * cfg.ang_vel_scale),
        (3, cfg.gravity_noise),
        (3, 0.0),
        (12, cfg.dof_pos_noise * cfg.dof_pos_scale),
        (12, cfg.dof_vel_noise * cfg.dof_vel_scale),
        (NUM_POINTS, cfg.height_noise * cfg.height_scale),
        (12, 0.0),
    )
    return torch.tensor([width * cfg.noise_level for count, width in parts for _ in range(count)])


def compute_anymal_terrain_observations(
    motion: BaseMotion,
    commands: Tensor,
    dof_pos: Tensor,
    dof_vel: Tensor,
    base_height: Tensor,
    ground: Tensor,
    actions: Tensor,
    cfg: TerrainLearnConfig,
) -> Tensor:
    """Return the observations (N, 188), without noise.

    Linear and angular velocity, gravity, 3 commands, 12 joint positions (not from the default
    angles, as in Anymal) and velocities, 140 heights, 12 actions.

    Args:
        motion: of the base, in its frame.
        commands: (3 or more, N) m/s and rad/s.
        dof_pos: (12, N) rad.
        dof_vel: (12, N) rad/s.
        base_height: (N,) m.
        ground: (140, N) m.
        actions: (12, N) of the last step.
        cfg: the scales.
    """
    heights = (base_height - _STANDING_M - ground).clamp_(-1.0, 1.0).mul_(cfg.height_scale)
    return torch.cat(
        (*proprioception(motion, commands, dof_pos, dof_vel, cfg), heights, actions)
    ).t()


def compute_air_time(air_time_s: Tensor, on_ground: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Return how long feet are in the air now, and by how much those that land exceeded 0.5 s.

    Args:
        air_time_s: (F, N) before this step.
        on_ground: (F, N) bool, in this step.
        dt: time that a step counts (s).

    Returns:
        (F, N) s, zero on the ground; (N,) s, summed over the feet that land in this step.
    """
    lands = on_ground & (air_time_s > 0.0)
    air_time_s = air_time_s + dt
    beyond = ((air_time_s - _WANTED_AIR_TIME_S) * lands).sum(0)
    return air_time_s.masked_fill(on_ground, 0.0), beyond


class WalkStep(NamedTuple):
    """The quantities that the reward of a step depends on.

    Attributes:
        motion: of the base, in its frame.
        commands: (3 or more, N) m/s and rad/s.
        base_height: (N,) m.
        dof_offset: (12, N) of the joints from their default angles (rad).
        dof_vel: (12, N) rad/s.
        last_dof_vel: (12, N) before the step.
        torques: (12, N) Nm.
        actions: (12, N).
        last_actions: (12, N) of the step before.
        knees_in_contact: (K, N) bool.
        foot_forces: (3, F, N) in world axes (N).
        air_time_beyond_s: (N,) see `compute_air_time`.
    """

    motion: BaseMotion
    commands: Tensor
    base_height: Tensor
    dof_offset: Tensor
    dof_vel: Tensor
    last_dof_vel: Tensor
    torques: Tensor
    actions: Tensor
    last_actions: Tensor
    knees_in_contact: Tensor
    foot_forces: Tensor
    air_time_beyond_s: Tensor


def compute_anymal_terrain_reward(step: WalkStep, cfg: TerrainLearnConfig, dt: float) -> Terms:
    """Return the terms (N,) of the reward, by the names that IsaacGymEnvs logs them under.

    Args:
        step: see `WalkStep`.
        cfg: the weights of the terms per second.
        dt: time of a control step (s).
    """
    motion = step.motion
    along, turning = compute_tracking_rewards(step.commands, motion)
    walks = step.commands[:2].square().sum(0) > _WALKING_M_S**2
    side, up = step.foot_forces[:2].square().sum(0), step.foot_forces[2].abs()
    stumbles = (side > _STUMBLE_SIDE_N**2) & (up < _STUMBLE_UP_N)
    values = {
        "lin_vel_xy": (along, cfg.lin_vel_xy_reward),
        "lin_vel_z": (motion.lin_vel[2].square(), cfg.lin_vel_z_reward),
        "ang_vel_z": (turning, cfg.ang_vel_z_reward),
        "ang_vel_xy": (_squares(motion.ang_vel[:2]), cfg.ang_vel_xy_reward),
        "orient": (_squares(motion.gravity[:2]), cfg.orientation_reward),
        "torques": (_squares(step.torques), cfg.torque_reward),
        "joint_acc": (_squares(step.last_dof_vel - step.dof_vel), cfg.joint_acc_reward),
        "base_height": ((step.base_height - _WANTED_HEIGHT_M).square(), cfg.base_height_reward),
        "air_time": (step.air_time_beyond_s * walks, cfg.air_time_reward),
        "collision": (step.knees_in_contact.sum(0), cfg.knee_collision_reward),
        "stumble": (stumbles.sum(0), cfg.stumble_reward),
        "action_rate": (_squares(step.last_actions - step.actions), cfg.action_rate_reward),
        "hip": (step.dof_offset[_HIPS].abs().sum(0), cfg.hip_reward),
    }
    return {name: value * (per_second * dt) for name, (value, per_second) in values.items()}


def _squares(values: Tensor) -> Tensor:
    return values.square().sum(0)
