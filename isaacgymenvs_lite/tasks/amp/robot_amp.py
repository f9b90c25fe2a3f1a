"""RobotAMP: any robot of an MJCF or URDF file that imitates motion clips."""

from __future__ import annotations

import functools
import logging
from dataclasses import dataclass, field

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.qpos import dofs_from_qpos
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.robots.load import load_robot
from isaacgymenvs_lite.robots.settings import RobotSettings
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import HumanoidAMPConfig
from isaacgymenvs_lite.tasks.amp.humanoid_model import set_actuators
from isaacgymenvs_lite.tasks.base.assets import asset_path, compile_spec
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig
from isaacgymenvs_lite.tasks.goals.velocity import Velocity
from isaacgymenvs_lite.utils.rotations import xyzw_from_wxyz

log = logging.getLogger(__name__)

_ROOT = 7  # numbers of the free joint in qpos: position, quaternion wxyz


@dataclass(frozen=True, kw_only=True)
class RobotAMPConfig(HumanoidAMPConfig, RobotSettings):
    """`task.env` of RobotAMP: HumanoidAMP's keys and a robot's; null means found in the model."""

    motion_file: str = setting("g1_walk.npz")
    """A clip of this robot: a path, or a name in assets/amp/motions."""
    contact_bodies: tuple[str, ...] = setting((), key="contactBodies")
    """Bodies that may touch the floor, names or patterns; (): what touches it in the start pose."""
    termination_height: float | None = setting(None, key="terminationHeight", above=0)
    """A touched robot with a body below this height (m) fell; null: a share of the start height."""
    action_scale: float = setting(2.0, key="actionScale", above=0, maximum=100)
    """Targets of the drives are the start pose + actionScale * action, in rad."""
    enforce_effort_limits: bool = setting(True, key="enforceEffortLimits")
    """Limit the drives' torques to the robot's efforts."""
    asset: AssetConfig = field(default_factory=lambda: AssetConfig("mjcf/g1.xml"))


# The mean speed of a clip that goes nowhere is below.
_STANDING_M_S = 0.05
# Of the start height: below it is a robot on its knees, not one that crouches.
_TERMINATION_SHARE = 0.45


class RobotAMP(HumanoidAMP):
    """A robot that is given by its file; bodies, drives and start pose are found or set by keys.

    Differs from HumanoidAMP: PD targets are offsets from the start pose, and efforts are limited.

    Raises:
        ConfigError: a file or key that cannot be used, see `robots.load.load_robot`.
        MotionFileError: a clip that cannot be used, or belongs to another robot.
    """

    settings_class = RobotAMPConfig
    default_asset = "mjcf/g1.xml"
    actor_name = "robot"
    num_dofs_of_assets = ()
    not_stored = (*HumanoidAMP.not_stored, "_robot", "_skeleton")

    def build_model(self) -> mujoco.MjModel:
        """Return the model of the robot on a floor; log what was taken and added."""
        path = asset_path(self.env_cfg.asset, self.default_asset)
        self._robot = load_robot(path, self.env_cfg, "task.env")
        _log_once(tuple(self._robot.describe()))
        friction = self.env_cfg.plane.dynamic_friction
        spec = self._robot.spec
        model = compile_spec(spec, path, self.sim_cfg, friction, self.change_spec)
        set_actuators(model, self.env_cfg)
        # Of the robot alone: a goal may have added objects.
        self._skeleton = Skeleton.from_model(self._robot.model, str(path))
        return model

    def key_body_names(self) -> tuple[str, ...]:
        """Return the bodies whose positions are observed."""
        return self._robot.key_bodies

    def contact_body_names(self) -> tuple[str, ...]:
        """Return the bodies that may touch the floor."""
        return self._robot.contact_bodies

    def reference_skeleton(self) -> Skeleton:
        """Return the robot's skeleton."""
        return self._skeleton

    def default_pose(self) -> tuple[Tensor, Tensor]:
        """Return root state (13,) and DOF positions (D,) rad of the start pose, on the floor."""
        qpos = self._robot.start_qpos
        root_state = torch.zeros(13, device=self.device)
        root_state[:3] = torch.from_numpy(qpos[:3])
        root_state[3:7] = xyzw_from_wxyz(torch.from_numpy(qpos[3:_ROOT]))
        (dof_pos,) = dofs_from_qpos(self._skeleton, qpos[None])
        return root_state, torch.from_numpy(dof_pos).float().to(self.device)

    def _termination_heights(self) -> float:
        height = self.env_cfg.termination_height
        return _TERMINATION_SHARE * self._robot.start_height if height is None else height

    def _pd_offset_scale(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Return offset and scale (D,) of PD targets: the start pose, and `actionScale`."""
        offset = self.default_pose()[1].to(lower)
        return offset, torch.full_like(offset, self.env_cfg.action_scale)


class RobotAMPVelocity(RobotAMP):
    """RobotAMP that moves as commanded: style from clips, velocities from commands.

    Raises:
        ConfigError: as RobotAMP; or no clip moves along the ground, but commands do.
    """

    goal_class = Velocity

    def create_sim(self) -> None:
        """As the base, and check that there is a clip to go with."""
        super().create_sim()
        ranges = self.goal.settings.command_ranges
        fastest_m_s = self.motion_lib.fastest_clip_m_s()
        if any((*ranges.linear_x, *ranges.linear_y)) and fastest_m_s < _STANDING_M_S:
            raise ConfigError(
                f"task.env.motion_file={self.env_cfg.motion_file}: no clip moves along the ground"
                f" (the fastest at {fastest_m_s:.3f} m/s), so that there is no style to follow"
                " task.env.randomCommandVelocityRanges with; give clips whose root moves"
            )


@functools.lru_cache(maxsize=1)
def _log_once(lines: tuple[str, ...]) -> None:
    """Log what was taken of a robot; a training makes its task again to measure the pose error."""
    for line in lines:
        log.info("%s", line)
