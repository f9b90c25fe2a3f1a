"""Settings, height scan, observations and rewards of AnymalTerrain, as in IsaacGymEnvs.

The functions are pure. The last dimension of all tensors is the number N of robots, for example (3,
N).
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
from isaacgymenvs_lite.tasks.terrain.grid import HORIZONTAL_M, VERTICAL_M, Terrain, TerrainConfig


@dataclass(frozen=True, kw_only=True)
class TerrainLearnConfig(LearnConfig):
    """`task.env.learn` of AnymalTerrain. Each `..._noise` is half the width of uniform noise."""

    torque_reward: float = setting(-0.00002, key="torqueRewardScale")
    lin_vel_z_reward: float = setting(-4.0, key="linearVelocityZRewardScale")
    ang_vel_xy_reward: float = setting(-0.05, key="angularVelocityXYRewardScale")
    orientation_reward: float = setting(0.0, key="orientationRewardScale")
    base_height_reward: float = setting(0.0, key="baseHeightRewardScale")
    joint_acc_reward: float = setting(-0.0005, key="jointAccRewardScale")
    knee_collision_reward: float = setting(-0.25, key="kneeCollisionRewardScale")
    stumble_reward: float = setting(0.0, key="feetStumbleRewardScale")
    action_rate_reward: float = setting(-0.01, key="actionRateRewardScale")
    air_time_reward: float = setting(1.0, key="feetAirTimeRewardScale")
    hip_reward: float = setting(0.0, key="hipRewardScale")
    terminal_reward: float = setting(0.0, key="terminalReward")
    allow_knee_contacts: bool = setting(True, key="allowKneeContacts")
    air_time_as_published: bool = setting(False, key="airTimeAsPublished")

    height_scale: float = setting(5.0, key="heightMeasurementScale")
    add_noise: bool = setting(True, key="addNoise")
    noise_level: float = setting(1.0, key="noiseLevel", minimum=0)
    dof_pos_noise: float = setting(0.01, key="dofPositionNoise", minimum=0)  # rad
    dof_vel_noise: float = setting(1.5, key="dofVelocityNoise", minimum=0)  # rad/s
    lin_vel_noise: float = setting(0.1, key="linearVelocityNoise", minimum=0)  # m/s
    ang_vel_noise: float = setting(0.2, key="angularVelocityNoise", minimum=0)  # rad/s
    gravity_noise: float = setting(0.05, key="gravityNoise", minimum=0)
    height_noise: float = setting(0.06, key="heightMeasurementNoise", minimum=0)  # m

    randomize_friction: bool = setting(True, key="randomizeFriction")
    friction_range: tuple[float, ...] = setting((0.5, 1.25), key="frictionRange", length=2)
    push_robots: bool = setting(True, key="pushRobots")
    push_interval_s: float = setting(15.0, key="pushInterval_s", above=0)
    episode_length_s: float = setting(20.0, key="episodeLength_s", above=0)


@dataclass(frozen=True, kw_only=True)
class TerrainControlConfig(ControlConfig):
    """`task.env.control` of AnymalTerrain."""

    stiffness: float = setting(80.0, minimum=0)  # Nm/rad
    decimation: int = setting(4, minimum=1)
    extra_call: bool = setting(False, key="extraSimulatorCall")


@dataclass(frozen=True, kw_only=True)
class HeadingCommandsConfig(CommandRangesConfig):
    """`task.env.randomCommandVelocityRanges` of AnymalTerrain, with lowest and highest commands."""

    linear_x: tuple[float, ...] = setting((-1.0, 1.0), length=2)  # m/s
    yaw: tuple[float, ...] = setting((-3.14, 3.14), length=2)  # rad, heading


@dataclass(frozen=True, kw_only=True)
class AnymalTerrainConfig(VelocityTrackingConfig):
    """`task.env` of AnymalTerrain."""

    clip_actions: float = setting(float("inf"), key="clipActions", above=0)
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    command_ranges: HeadingCommandsConfig = setting(
        HeadingCommandsConfig(), key="randomCommandVelocityRanges"
    )
    control: TerrainControlConfig = field(default_factory=TerrainControlConfig)
    learn: TerrainLearnConfig = field(default_factory=TerrainLearnConfig)


_STANDING_M = 0.5  # subtracted from observed heights
_WANTED_HEIGHT_M = 0.52
_WANTED_AIR_TIME_S = 0.5
_WALKING_M_S = 0.1  # slower commands earn no reward for air time
_STUMBLE_SIDE_N, _STUMBLE_UP_N = 5.0, 1.0
TERM_NAMES = (
    *("lin_vel_xy", "lin_vel_z", "ang_vel_z", "ang_vel_xy", "orient", "torques", "joint_acc"),
    *("base_height", "air_time", "collision", "stumble", "action_rate", "hip"),
)
"""IsaacGymEnvs logs the reward terms under these names."""
_HIPS = slice(0, 12, 3)  # first joint of each leg
# Distances (m) of scanned points along x and along y of the heading frame.
_SIDE_X = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
_SIDE_Y = (0.1, 0.2, 0.3, 0.4, 0.5)
NUM_POINTS = 4 * len(_SIDE_X) * len(_SIDE_Y)


def scan_points() -> Tensor:
    """Return the scanned points (2, 140) m around a robot. As in IsaacGymEnvs, y varies fastest."""
    x = torch.tensor([*(-v for v in reversed(_SIDE_X)), *_SIDE_X])
    y = torch.tensor([*(-v for v in reversed(_SIDE_Y)), *_SIDE_Y])
    return torch.stack(torch.meshgrid(x, y, indexing="ij")).flatten(1)


class HeightScan:
    """Measures the height of the ground around N robots.

    As in IsaacGymEnvs, the height at a point is the lower of two opposite corners of its grid
    square.
    """

    def __init__(self, terrain: Terrain, device: torch.device) -> None:
        samples = torch.from_numpy(terrain.samples)
        lower = torch.minimum(samples[:-1, :-1], samples[1:, 1:])
        self._heights = (lower * VERTICAL_M).to(device)
        self._last = [n - 1 for n in self._heights.shape]
        self._border = terrain.border_m
        self._points = scan_points().to(device)[..., None]

    def __call__(self, root_pos: Tensor, root_rot: Tensor) -> Tensor:
        """Return the ground heights (140, N) in m around robots at `root_pos` (N, 3) m.

        Only the rotation about z that z and w of `root_rot` (N, 4) xyzw determine is used.
        """
        z, w = root_rot[:, 2], root_rot[:, 3]
        length = (z * z + w * w).clamp(min=1e-12)
        cos, sin = (w * w - z * z) / length, 2.0 * w * z / length
        ahead, aside = self._points
        x = ahead * cos - aside * sin + root_pos[:, 0]
        y = ahead * sin + aside * cos + root_pos[:, 1]
        rows, columns = self._samples_at(x, self._last[0]), self._samples_at(y, self._last[1])
        return self._heights.take(rows.mul_(self._heights.shape[1]).add_(columns))

    def _samples_at(self, coordinates: Tensor, last: int) -> Tensor:
        return coordinates.add_(self._border).div_(HORIZONTAL_M).clamp_(0, last).long()


def noise_widths(cfg: TerrainLearnConfig) -> Tensor:
    """Return half the widths (188,) of the uniform noise on scaled observations."""
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
    """Return the observations (N, 188) without noise.

    First come linear and angular velocity, gravity and 3 commands. Then come 12 joint positions and
    velocities, 140 heights, and 12 actions. The default angles are not subtracted from the joint
    positions. The arguments have the shapes (3 or more, N) and (12, N). `base_height` (N,) and the
    heights `ground` (140, N) are in m.
    """
    heights = (base_height - _STANDING_M - ground).clamp_(-1.0, 1.0).mul_(cfg.height_scale)
    return torch.cat(
        (*proprioception(motion, commands, dof_pos, dof_vel, cfg), heights, actions)
    ).t()


def compute_air_time(air_time_s: Tensor, on_ground: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Return the air times (F, N) s after a step, and their excess over 0.5 s at landings, (N,) s.

    `air_time_s` (F, N) are the air times before the step, `on_ground` (F, N) says which feet touch
    the ground, and `dt` is the duration of the step (s). The excess is summed over landing feet.
    """
    lands = on_ground & (air_time_s > 0.0)
    air_time_s = air_time_s + dt
    beyond = ((air_time_s - _WANTED_AIR_TIME_S) * lands).sum(0)
    return air_time_s.masked_fill(on_ground, 0.0), beyond


class WalkStep(NamedTuple):
    """Quantities that determine the reward of a step."""

    motion: BaseMotion
    commands: Tensor  # (3 or more, N) m/s and rad/s
    base_height: Tensor  # (N,) m
    dof_offset: Tensor  # (12, N) rad, from the default angles
    dof_vel: Tensor  # (12, N) rad/s
    last_dof_vel: Tensor  # (12, N) before the step
    torques: Tensor  # (12, N) Nm
    actions: Tensor  # (12, N)
    last_actions: Tensor  # (12, N) of the previous step
    knees_in_contact: Tensor  # (K, N) bool
    foot_forces: Tensor  # (3, F, N) newton, in world axes
    air_time_beyond_s: Tensor  # (N,) see `compute_air_time`


def compute_anymal_terrain_reward(step: WalkStep, cfg: TerrainLearnConfig, dt: float) -> Terms:
    """Return the reward terms (N,) under their names in IsaacGymEnvs.

    The weights of `cfg` are per second, and `dt` is the time of a control step (s).
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
