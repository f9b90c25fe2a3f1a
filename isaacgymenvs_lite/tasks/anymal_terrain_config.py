"""Keys of `task.env` of AnymalTerrain."""

from __future__ import annotations

from dataclasses import dataclass, field

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.velocity_tracking import (
    CommandRangesConfig,
    ControlConfig,
    LearnConfig,
    VelocityTrackingConfig,
)
from isaacgymenvs_lite.tasks.terrain.grid import TerrainConfig


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
