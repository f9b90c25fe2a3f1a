"""RobotAMP: any robot of an MJCF or URDF file that imitates motion clips."""

from __future__ import annotations

import logging
import math
from dataclasses import asdict, dataclass, field
from typing import Any

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.qpos import dofs_from_qpos
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.robots.load import load_robot
from isaacgymenvs_lite.robots.settings import RobotSettings
from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.tasks.amp.deployable_observations import (
    add_noise,
    compute_frame,
    history_groups,
    noise_widths,
)
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import CharacterState
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import HumanoidAMPConfig
from isaacgymenvs_lite.tasks.amp.humanoid_model import set_actuators
from isaacgymenvs_lite.tasks.base.assets import asset_path, compile_spec
from isaacgymenvs_lite.tasks.base.history import ActionDelay, push_newest
from isaacgymenvs_lite.tasks.base.pushes import push_interval, set_planar_velocities
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig
from isaacgymenvs_lite.tasks.goals.velocity import Velocity
from isaacgymenvs_lite.utils.rotations import xyzw_from_wxyz

log = logging.getLogger(__name__)

_ROOT = 7  # numbers of the free joint in qpos: position, quaternion wxyz
# The mean speed of a clip that goes nowhere is below.
_STANDING_M_S = 0.05
# Of the trunk's height: below it is a robot on its knees, not one that crouches.
_TERMINATION_SHARE = 0.45
_MAX_FRAMES = 100
_MAX_DELAY = 100  # control steps


@dataclass(frozen=True, kw_only=True)
class ObservationNoise:
    """`task.env.observationNoise`: half widths of uniform noise on the parts of a frame."""

    root_ang_vel_b: float = setting(0.0, minimum=0)  # rad/s
    gravity_b: float = setting(0.0, minimum=0)
    dof_pos_offset: float = setting(0.0, minimum=0)  # rad
    dof_vel: float = setting(0.0, minimum=0)  # rad/s

    @property
    def widths(self) -> dict[str, float]:
        """Half width of each part by its name."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class RobotAMPConfig(HumanoidAMPConfig, RobotSettings):
    """`task.env` of RobotAMP: HumanoidAMP's keys and a robot's; null means found in the model."""

    motion_file: str = setting("g1_walk.npz")
    contact_bodies: tuple[str, ...] = setting((), key="contactBodies")
    termination_height: float | None = setting(None, key="terminationHeight", above=0)  # m
    action_scale: float | None = setting(None, key="actionScale", above=0, maximum=100)
    enforce_effort_limits: bool = setting(True, key="enforceEffortLimits")
    asset: AssetConfig = field(default_factory=lambda: AssetConfig("mjcf/g1.xml"))
    observations: str = setting("full", choices=("full", "deployable"))
    history_steps: int = setting(1, key="historySteps", minimum=1, maximum=_MAX_FRAMES)
    observation_noise: ObservationNoise = field(
        default_factory=ObservationNoise, metadata={"key": "observationNoise"}
    )
    action_delay: tuple[int, ...] = setting(
        (0, 0), key="actionDelay", minimum=0, maximum=_MAX_DELAY, length=2
    )  # control steps
    push_robots: bool = setting(False, key="pushRobots")
    push_interval_s: float = setting(5.0, key="pushInterval_s", above=0)
    push_velocity: float = setting(0.5, key="pushVelocity", minimum=0, maximum=100)  # m/s

    @property
    def is_deployable(self) -> bool:
        """Whether the policy observes only what a robot measures."""
        return self.observations == "deployable"


def check_realism(settings: RobotAMPConfig, env: dict[str, Any]) -> None:
    """Check keys of `task.env` that depend on each other.

    Raises:
        ConfigError: an empty range, an unknown part, or a key that has no effect.
    """
    # Once more as a whole section: a part that does not exist would be left without its noise.
    noise = env.get("observationNoise")
    read_section(ObservationNoise, noise, "task.env.observationNoise", complete=True)
    unread = sorted(set(noise or ()) - set(settings.observation_noise.widths))
    if unread:
        raise ConfigError(
            f"task.env.observationNoise.{unread[0]}: no measured part has this name; choices:"
            f" {', '.join(settings.observation_noise.widths)}"
        )
    least, most = settings.action_delay
    if least > most:
        raise ConfigError(
            f"task.env.actionDelay=[{least}, {most}]: expected the least number of control steps,"
            " then the most"
        )
    if settings.is_deployable:
        return
    if settings.history_steps > 1:
        raise ConfigError(
            f"task.env.historySteps={settings.history_steps}: only observations of a robot's own"
            " measurements have a history; add task.env.observations=deployable, or leave it 1"
        )
    if any(settings.observation_noise.widths.values()):
        raise ConfigError(
            "task.env.observationNoise is of a robot's measurements; add"
            " task.env.observations=deployable (noise on the full observation:"
            " task.task.randomization_params.observations)"
        )


class RobotAMP(HumanoidAMP):
    """A robot that is given by its file; bodies, drives and start pose are found or set by keys.

    Differs from HumanoidAMP: PD targets are offsets from the start pose, and efforts are limited.
    With `observations: deployable` the policy observes what a robot measures, see
    `deployable_observations`, and an asymmetric critic all of the state; the AMP observation stays
    the same. Noise is on the policy's frames alone.

    Raises:
        ConfigError: a file or key that cannot be used, see `robots.load.load_robot`.
        MotionFileError: a clip that cannot be used, or belongs to another robot.
    """

    settings_class = RobotAMPConfig
    default_asset = "mjcf/g1.xml"
    actor_name = "robot"
    num_dofs_of_assets = ()

    def read_settings(self, env: dict[str, Any]) -> RobotAMPConfig:
        """As the base, and check the keys that depend on each other."""
        config: RobotAMPConfig = super().read_settings(env)
        check_realism(config, env)
        return config

    def build_model(self) -> mujoco.MjModel:
        """Return the model of the robot on a floor; log what was taken and added."""
        path = asset_path(self.env_cfg.asset, self.default_asset)
        self._robot = load_robot(path, self.env_cfg, "task.env")
        self._spec = self._robot.spec
        scale = f"actionScale: {self._action_scale_rad():.3g} rad"
        for line in (*self._robot.describe(), scale):
            log.info("%s", line)
        friction = self.env_cfg.plane.dynamic_friction
        model = compile_spec(self._spec, path, self.sim_cfg, friction, self.change_spec)
        set_actuators(model, self.env_cfg)
        # Of the robot alone: a goal may have added objects.
        self._skeleton = Skeleton.from_model(self._robot.model, str(path))
        return model

    def _action_scale_rad(self) -> float:
        given = self.env_cfg.action_scale
        return self._robot.action_range_rad if given is None else given

    def key_body_names(self) -> tuple[str, ...]:
        """Return the bodies whose positions are observed."""
        return self._robot.key_bodies

    def contact_body_names(self) -> tuple[str, ...]:
        """Return the bodies that may touch the floor."""
        return self._robot.contact_bodies

    @property
    def allows_contacts_of_clips(self) -> bool:
        """As the base, of the bodies that were found."""
        return not self.env_cfg.contact_bodies

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
        return _TERMINATION_SHARE * self._robot.trunk_height if height is None else height

    def _pd_offset_scale(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Return offset and scale (D,) of PD targets: the start pose, and `actionScale`."""
        offset = self.default_pose()[1].to(lower)
        return offset, torch.full_like(offset, self._action_scale_rad())

    # --- what a robot measures, and what disturbs it -----------------------------------------

    def character_observation_groups(self) -> dict[str, int]:
        """As the base, or `history_groups`."""
        if not self.env_cfg.is_deployable:
            return super().character_observation_groups()
        return history_groups(self._layout.num_dofs, self.env_cfg.history_steps)

    def observation_frames(self) -> dict[str, str]:
        """As the base, and of what a robot measures."""
        measured = {"root_ang_vel_b": "base", "gravity_b": "base", "dof_pos_offset": "joint"}
        return super().observation_frames() | measured

    def states_size(self) -> int:
        """As the base, or see `compute_states`."""
        if not self.env_cfg.is_deployable:
            return super().states_size()
        own = self._num_amp_obs_per_step + self._layout.num_dofs + 1
        return own + self.get_task_obs_size()

    def allocate_buffers(self) -> None:
        """Add the policy's frames (N, H, F), newest first, and the delay of the actions."""
        super().allocate_buffers()
        cfg, num_dofs, n = self.env_cfg, self._layout.num_dofs, self.num_envs
        self._frames: Tensor | None = None
        self._noise_widths: Tensor | None = None
        self._delay: ActionDelay | None = None
        self.push_interval = push_interval(cfg.push_interval_s, self.control_dt_s)
        if cfg.is_deployable:
            self._start_dof_pos = self.default_pose()[1]
            size = sum(history_groups(num_dofs, 1).values())
            self._frames = torch.zeros(n, cfg.history_steps, size, device=self.device)
        if any(cfg.observation_noise.widths.values()):
            widths = noise_widths(cfg.observation_noise.widths, num_dofs)
            self._noise_widths = widths.to(self.device)
        least, most = cfg.action_delay
        if most > 0:
            self._delay = ActionDelay(least, most, n, self.num_actions, self.device)

    def pre_physics_step(self, actions: Tensor) -> None:
        """As the base; push the robots first, if it is due."""
        is_due = self.control_steps > 0 and self.control_steps % self.push_interval == 0
        if self.env_cfg.push_robots and is_due:
            largest = self.env_cfg.push_velocity
            change = uniform(self.reset_buf, -largest, largest, (2,))
            set_planar_velocities(self.simulation, self.simulation.root_states[:, 7:9] + change)
        super().pre_physics_step(actions)

    def compute_controls(self, actions: Tensor) -> Tensor:
        """As the base, of the actions that take effect now; a delay stores those that came."""
        return super().compute_controls(actions if self._delay is None else self._delay(actions))

    def update_state(self) -> None:
        """Take the newest frames into the history."""
        super().update_state()
        if self._frames is not None:
            push_newest(self._frames, self._measure(None, self.actions))

    def reset_state(self, env_ids: Tensor) -> None:
        """As the base; draw delays, and fill the history with the first frame."""
        super().reset_state(env_ids)
        if self._delay is not None:
            self._delay.reset(env_ids)
        if self._frames is not None:
            first = self._measure(env_ids, torch.zeros_like(self.actions[env_ids]))
            first = first.unsqueeze(1).expand(-1, self._frames.shape[1], -1)
            self._frames.index_copy_(0, env_ids, first)

    def _measure(self, env_ids: Tensor | None, last_action: Tensor) -> Tensor:
        """Return frames with noise of all robots, or of `env_ids` (n,)."""
        root_states, dof_pos, dof_vel, _ = self._character_states(env_ids)
        frame = compute_frame(root_states, dof_pos, dof_vel, self._start_dof_pos, last_action)
        return frame if self._noise_widths is None else add_noise(frame, self._noise_widths)

    def _observe_clip(self, states: CharacterState) -> Tensor | None:
        """None of what a robot measures: clips do not show its earlier actions."""
        return super()._observe_clip(states) if self._frames is None else None

    def _observe_character(self, env_ids: Tensor | None) -> Tensor:
        """As the base, or the frames of the last control steps, newest first."""
        if self._frames is None:
            return super()._observe_character(env_ids)
        frames = self._frames if env_ids is None else self._frames.index_select(0, env_ids)
        return frames.flatten(1)

    def compute_states(self, env_ids: Tensor | None, observations: Tensor) -> Tensor:
        """Return what the critic of a `deployable` policy observes, (n, numStates).

        The full observation of the character without noise, the clamped action of the last step
        (D), the delay of the episode's actions (1, control steps), and the goal.
        """
        if self._frames is None:
            return observations
        rows = slice(None) if env_ids is None else env_ids
        last_action = self._frames[rows, 0, -self.num_actions :]
        delay = torch.zeros_like(observations[:, :1])
        if self._delay is not None:
            delay += self._delay.steps[rows].unsqueeze(1)
        goal = observations[:, self._frames[0].numel() :]
        return torch.cat((super()._observe_character(env_ids), last_action, delay, goal), dim=-1)

    def current_amp_features(self, env_ids: Tensor | None = None) -> Tensor:
        """As the base, whatever the policy observes."""
        if self._frames is None:
            return super().current_amp_features(env_ids)
        if self.num_states == 0:
            return self._amp_features(self._character_states(env_ids))
        features = self.states_buf[:, : self._num_amp_obs_per_step]  # the critic's first part
        return features if env_ids is None else features.index_select(0, env_ids)


class RobotAMPVelocity(RobotAMP):
    """RobotAMP that moves as commanded: style from clips, velocities from commands.

    Raises:
        ConfigError: as RobotAMP; or no clip moves along the ground, but commands do.
    """

    goal_class = Velocity
    goal: Velocity

    def create_sim(self) -> None:
        """As the base, and check that there is a clip to go with."""
        super().create_sim()
        ranges = self.goal.settings.command_ranges
        if any((*ranges.linear_x, *ranges.linear_y)):
            self._check_clips_go()

    def _check_clips_go(self) -> None:
        """Refuse clips of which none goes; warn of those that go sideways."""
        fastest_m_s = self.motion_lib.fastest_clip_m_s()
        where = f"task.env.motion_file={self.env_cfg.motion_file}"
        if fastest_m_s < _STANDING_M_S:
            raise ConfigError(
                f"{where}: no clip moves along the ground"
                f" (the fastest at {fastest_m_s:.3f} m/s), so that there is no style to follow"
                " task.env.randomCommandVelocityRanges with; give clips whose root moves"
            )
        forward_m_s, left_m_s, _ = self.goal.planar_motion(self._roots_of_clips()).mean(0).tolist()
        if abs(left_m_s) > max(abs(forward_m_s), _STANDING_M_S):
            quarter = math.copysign(math.pi / 2, left_m_s)
            front_rad = self.goal.settings.forward_yaw_rad + quarter
            log.warning(
                "%s: the clips go to the left at %.2f m/s and forward at %.2f m/s; if that is the"
                " front of the robot, which is not the x axis of its base, set"
                " task.env.forwardYaw=%.2f",
                *(where, left_m_s, forward_m_s, math.remainder(front_rad, 2 * math.pi)),
            )

    def _roots_of_clips(self) -> Tensor:
        """Return (frames of all clips, 13), the states of the root."""
        parts = []
        for index in range(self.motion_lib.num_motions()):
            clip = self.motion_lib.get_motion(index)
            velocities = clip.linear_velocity_w[:, 0], clip.angular_velocity_w[:, 0]
            arrays = (clip.root_translation, clip.local_rotation[:, 0], *velocities)
            parts.append(torch.cat([torch.from_numpy(a).float() for a in arrays], dim=-1))
        return torch.cat(parts)
