"""Common parts of Anymal and AnymalTerrain: a legged robot follows commanded velocities.

The formulas come from IsaacGymEnvs. The last dimension of all tensors is the number N of
environments, for example (3, N).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any, ClassVar, NamedTuple

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.assets import asset_path, compile_model
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms, total
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig, TaskConfig
from isaacgymenvs_lite.tasks.base.vec_task import ActionScaling
from isaacgymenvs_lite.utils.rotations import rotate_components

_TRACKING_VARIANCE = 0.25  # (m/s)^2 and (rad/s)^2
_START_POS_FACTORS = (0.5, 1.5)  # multiplied with the default joint angles
_START_VEL_RAD_S = 0.1
CONTACT_THRESHOLD_N = 1.0


@dataclass(frozen=True, kw_only=True)
class InitStateConfig:
    """`task.env.baseInitState`: state of the base at the start of an episode, in world axes."""

    pos: tuple[float, ...] = setting((0.0, 0.0, 0.62), length=3)  # m
    rot: tuple[float, ...] = setting((0.0, 0.0, 0.0, 1.0), length=4)  # xyzw
    lin_vel: tuple[float, ...] = setting((0.0, 0.0, 0.0), key="vLinear", length=3)  # m/s
    ang_vel: tuple[float, ...] = setting((0.0, 0.0, 0.0), key="vAngular", length=3)  # rad/s


@dataclass(frozen=True, kw_only=True)
class ControlConfig:
    """`task.env.control`: the PD controller, whose targets are joint positions."""

    stiffness: float = setting(85.0, minimum=0)  # Nm/rad
    damping: float = setting(2.0, minimum=0)  # Nm s/rad
    action_scale: float = setting(0.5, key="actionScale")  # rad for a full action


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """`task.env.learn`: reward weights per second, and scales of the observations."""

    lin_vel_xy_reward: float = setting(1.0, key="linearVelocityXYRewardScale")
    ang_vel_z_reward: float = setting(0.5, key="angularVelocityZRewardScale")
    torque_reward: float = setting(-0.000025, key="torqueRewardScale")
    lin_vel_scale: float = setting(2.0, key="linearVelocityScale")
    ang_vel_scale: float = setting(0.25, key="angularVelocityScale")
    dof_pos_scale: float = setting(1.0, key="dofPositionScale")
    dof_vel_scale: float = setting(0.05, key="dofVelocityScale")
    episode_length_s: float = setting(50.0, key="episodeLength_s", above=0)


@dataclass(frozen=True, kw_only=True)
class CommandRangesConfig:
    """`task.env.randomCommandVelocityRanges`: lowest and highest commands."""

    linear_x: tuple[float, ...] = setting((-2.0, 2.0), length=2)  # m/s
    linear_y: tuple[float, ...] = setting((-1.0, 1.0), length=2)  # m/s
    yaw: tuple[float, ...] = setting((-1.0, 1.0), length=2)  # rad/s


@dataclass(frozen=True, kw_only=True)
class UrdfAssetConfig:
    """`task.env.urdfAsset`."""

    file: str = setting("")  # MJCF; empty: the task's MJCF
    knee_name: str = setting("THIGH", key="kneeName")
    foot_name: str = setting("SHANK", key="footName")
    collapse_fixed_joints: bool = setting(True, key="collapseFixedJoints")  # no effect
    fix_base_link: bool = setting(False, key="fixBaseLink", choices=(False,))
    drive_mode: int = setting(4, key="defaultDofDriveMode")  # no effect


@dataclass(frozen=True, kw_only=True)
class VelocityTrackingConfig(TaskConfig):
    """Keys of `task.env` that Anymal and AnymalTerrain share."""

    init_state: InitStateConfig = setting(InitStateConfig(), key="baseInitState")
    command_ranges: CommandRangesConfig = setting(
        CommandRangesConfig(), key="randomCommandVelocityRanges"
    )
    default_joint_angles: dict[str, Any] = setting(key="defaultJointAngles")  # rad
    urdf_asset: UrdfAssetConfig = setting(UrdfAssetConfig(), key="urdfAsset")
    viewer: dict[str, Any] = setting({})  # no effect


class BaseMotion(NamedTuple):
    """Linear velocity, angular velocity and direction of gravity in base axes, (3, N) each."""

    lin_vel: Tensor
    ang_vel: Tensor
    gravity: Tensor


def compute_base_motion(root_states: Tensor) -> BaseMotion:
    """Return velocities and gravity in the base frames of `root_states` (N, 13)."""
    planes = root_states.t()
    x, y, z, w = planes[3:7].unbind()
    # Each component has the shape (2, N) for linear and angular velocity.
    velocities = planes[7:13].reshape(2, 3, -1).unbind(1)
    lin_vel, ang_vel = torch.stack(rotate_components((-x, -y, -z, w), velocities)).unbind(1)
    down = (w * y - x * z, -(y * z + w * x), x * x + y * y - 0.5)
    return BaseMotion(lin_vel, ang_vel, 2.0 * torch.stack(down))


def compute_tracking_rewards(commands: Tensor, motion: BaseMotion) -> tuple[Tensor, Tensor]:
    """Return rewards (N,) in (0, 1] for tracking the commanded velocity and yaw rate.

    The first three rows of `commands` (3 or more, N) are velocities along x and y of the base
    (m/s), and the yaw rate (rad/s).
    """
    return tracking_kernels(commands[:2] - motion.lin_vel[:2], commands[2] - motion.ang_vel[2])


def tracking_kernels(lin_vel_errors: Tensor, yaw_errors: Tensor) -> tuple[Tensor, Tensor]:
    """Return exp(-error^2 / 0.25) (N,) for velocity errors (2, N) and for yaw rate errors (N,)."""
    squares = torch.stack((lin_vel_errors.square().sum(0), yaw_errors.square()))
    along, turning = squares.div_(-_TRACKING_VARIANCE).exp_().unbind()
    return along, turning


def clip_negative_total(terms: Terms) -> Terms:
    """Add the term `clamp`, which raises a negative sum of the terms (N,) to zero."""
    return {**terms, "clamp": total(terms).neg().clamp(min=0.0)}


def joint_angles(named: Mapping[str, Any], joint_names: Sequence[str]) -> Tensor:
    """Return `task.env.defaultJointAngles` (D,) in rad, in the order of the joints.

    Raises:
        ConfigError: a joint has no angle, an angle has no joint, or an angle is no number.
    """
    wrong = sorted(set(named) ^ set(joint_names), key=str)
    if wrong:
        problem = "unknown joint" if wrong[0] in named else "missing joint"
        raise ConfigError(
            f"task.env.defaultJointAngles: {problem} {wrong[0]}; expected one angle for each of"
            f" {', '.join(joint_names)}"
        )
    try:
        return torch.tensor([float(named[name]) for name in joint_names])
    except (TypeError, ValueError):
        raise ConfigError(f"task.env.defaultJointAngles={dict(named)}: expected numbers") from None


def proprioception(
    motion: BaseMotion, commands: Tensor, dof_pos: Tensor, dof_vel: Tensor, cfg: LearnConfig
) -> tuple[Tensor, ...]:
    """Return scaled base motion, commands, joint positions and joint velocities as one list.

    `commands` (3 or more, N) are in m/s and rad/s, `dof_pos` (D, N) is in rad, and `dof_vel` (D, N)
    is in rad/s.
    """
    return (
        motion.lin_vel * cfg.lin_vel_scale,
        motion.ang_vel * cfg.ang_vel_scale,
        motion.gravity,
        commands[:2] * cfg.lin_vel_scale,
        commands[2:3] * cfg.ang_vel_scale,
        dof_pos * cfg.dof_pos_scale,
        dof_vel * cfg.dof_vel_scale,
    )


class VelocityTrackingTask(MjcfTask):
    """N legged robots that follow commanded velocities.

    Attributes:
        default_dof_pos: (D,) rad.
        commands: (N, num_commands) velocities along x and y of the base (m/s), yaw rate (rad/s),
            and additional commands of the task.
    """

    num_commands: ClassVar[int] = 3

    def build_model(self) -> mujoco.MjModel:
        """Return the compiled model of the file in `task.env.urdfAsset`."""
        if self.env_cfg.asset != AssetConfig():
            raise ConfigError("task.env.asset: use task.env.urdfAsset.file in this task")
        asset = AssetConfig(asset_file_name=self.env_cfg.urdf_asset.file)
        path = asset_path(
            asset, self.default_asset, self.published_assets, key="task.env.urdfAsset.file"
        )
        return compile_model(
            path, self.default_asset, self.sim_cfg, self._friction(), self.change_spec
        )

    def _friction(self) -> float:
        return self.env_cfg.plane.dynamic_friction

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Set the drive gains from the configuration."""
        control = self.env_cfg.control
        for actuator in spec.actuators:
            actuator.set_to_position(kp=control.stiffness, kv=control.damping)

    def create_sim(self) -> None:
        """Create the simulations and look up bodies, joints and command ranges."""
        super().create_sim()
        device, cfg = self.device, self.env_cfg
        angles = joint_angles(cfg.default_joint_angles, self.simulation.dof_names)
        self.default_dof_pos = angles.to(device)
        self._start_root = torch.cat([torch.tensor(part) for part in astuple(cfg.init_state)])
        self._start_root = self._start_root.to(device)
        self._ranges = torch.tensor(astuple(cfg.command_ranges), device=device)
        self._knee_ids = self._bodies_called(cfg.urdf_asset.knee_name, "kneeName")
        self._foot_ids = self._bodies_called(cfg.urdf_asset.foot_name, "footName")

    def _bodies_called(self, part: str, key: str) -> Tensor:
        names = self.simulation.body_names
        found = [place for place, name in enumerate(names) if part in name]
        if not found:
            raise ConfigError(
                f"task.env.urdfAsset.{key}='{part}': no body name contains it; bodies:"
                f" {', '.join(names)}"
            )
        return torch.tensor(found, device=self.device)

    def allocate_buffers(self) -> None:
        """Add the commands and the joint torques of the last step."""
        super().allocate_buffers()
        self._command_planes = torch.zeros(self.num_commands, self.num_envs, device=self.device)
        self.commands = self._command_planes.t()
        self._motion: BaseMotion | None = None
        # The first read makes the backend measure the torques.
        self._torques = self.simulation.dof_forces.t()

    def proprioception_groups(self) -> dict[str, int]:
        """Return names and sizes of the parts of `proprioception`."""
        num_dofs = self._layout.num_dofs
        motion = dict.fromkeys(("base_lin_vel", "base_ang_vel", "gravity", "commands"), 3)
        return motion | {"dof_pos": num_dofs, "dof_vel": num_dofs}

    def action_scaling(self) -> ActionScaling:
        """Return the mapping from actions to joint position targets (rad)."""
        scale = torch.full_like(self.default_dof_pos, self.env_cfg.control.action_scale)
        return ActionScaling("rad", self.default_dof_pos, scale)

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the joint position targets (N, D) in rad."""
        return actions * self.env_cfg.control.action_scale + self.default_dof_pos

    def in_contact(self, body_ids: Tensor) -> Tensor:
        """Return where (K, N) the contact force on bodies (K,) exceeds `CONTACT_THRESHOLD_N`."""
        forces = self.simulation.contact_forces.permute(2, 1, 0).index_select(1, body_ids)
        return forces.square().sum(0) > CONTACT_THRESHOLD_N * CONTACT_THRESHOLD_N

    def base_motion(self) -> BaseMotion:
        """See `compute_base_motion`."""
        if self._motion is None:
            self._motion = compute_base_motion(self.simulation.root_states)
        return self._motion

    def update_state(self) -> None:
        """Store the joint torques (D, N), and discard the cached base motion."""
        self._torques = self.simulation.dof_forces.t()
        self._motion = None

    def draw_commands(self, env_ids: Tensor) -> Tensor:
        """Draw random commands (3, n): velocities along x and y, and `yaw`."""
        low, high = self._ranges[:, :1], self._ranges[:, 1:]
        return low + (high - low) * torch.rand(3, len(env_ids), device=self.device)

    def draw_start_joints(self, env_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Draw start positions (rad) and start velocities (rad/s) of joints, (n, D) each."""
        size = (len(self.default_dof_pos),)
        pos = self.default_dof_pos * uniform(env_ids, *_START_POS_FACTORS, size)
        return pos, uniform(env_ids, -_START_VEL_RAD_S, _START_VEL_RAD_S, size)
