"""RobotAMP: any robot with an MJCF or URDF file imitates motion clips."""

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
    ActionDelay,
    add_noise,
    compute_frame,
    history_groups,
    noise_widths,
    push_newest,
)
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import (
    CharacterState,
    HumanoidAMPConfig,
    set_actuators,
)
from isaacgymenvs_lite.tasks.base.assets import asset_path, compile_spec
from isaacgymenvs_lite.tasks.base.pushes import push_interval, set_planar_velocities
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig
from isaacgymenvs_lite.tasks.goals.velocity import Velocity
from isaacgymenvs_lite.utils.rotations import xyzw_from_wxyz

log = logging.getLogger(__name__)

_ROOT = 7  # number of qpos values of the free joint
_STANDING_M_S = 0.05  # a clip with a lower mean speed counts as standing
_TERMINATION_SHARE = 0.45  # of the trunk's height; kneeling is lower, crouching is higher
_MAX_FRAMES = 100
_MAX_DELAY = 100  # control steps


@dataclass(frozen=True, kw_only=True)
class ObservationNoise:
    """`task.env.observationNoise`: half widths of uniform noise on measured quantities."""

    root_ang_vel_b: float = setting(0.0, minimum=0)  # rad/s
    gravity_b: float = setting(0.0, minimum=0)
    dof_pos_offset: float = setting(0.0, minimum=0)  # rad
    dof_vel: float = setting(0.0, minimum=0)  # rad/s


@dataclass(frozen=True, kw_only=True)
class RobotAMPConfig(HumanoidAMPConfig, RobotSettings):
    """`task.env` of RobotAMP. The model determines the keys of the robot that are null."""

    motion_file: str = setting("g1_walk.npz")
    contact_bodies: tuple[str, ...] = setting((), key="contactBodies")
    termination_height: float | None = setting(None, key="terminationHeight", above=0)  # m
    action_scale: float | None = setting(None, key="actionScale", above=0, maximum=100)
    enforce_effort_limits: bool = setting(True, key="enforceEffortLimits")
    asset: AssetConfig = field(default_factory=lambda: AssetConfig("mjcf/g1.xml"))
    observations: str = setting("full", choices=("full", "deployable"))
    history_steps: int = setting(1, key="historySteps", minimum=1, maximum=_MAX_FRAMES)
    observation_noise: ObservationNoise = setting(ObservationNoise(), key="observationNoise")
    action_delay: tuple[int, ...] = setting(
        (0, 0), key="actionDelay", minimum=0, maximum=_MAX_DELAY, length=2
    )  # control steps
    push_robots: bool = setting(False, key="pushRobots")
    push_interval_s: float = setting(5.0, key="pushInterval_s", above=0)
    push_velocity: float = setting(0.5, key="pushVelocity", minimum=0, maximum=100)  # m/s

    @property
    def is_deployable(self) -> bool:
        """Whether the policy observes only quantities that a robot measures."""
        return self.observations == "deployable"


def check_realism(settings: RobotAMPConfig, env: dict[str, Any]) -> None:
    """Check settings that depend on each other.

    Raises:
        ConfigError: a range is empty, a part of the noise is unknown, or a key has no effect.
    """
    noise = env.get("observationNoise")
    read_section(ObservationNoise, noise, "task.env.observationNoise", complete=True)
    parts = asdict(settings.observation_noise)
    if unread := sorted(set(noise or ()) - set(parts)):
        raise ConfigError(
            f"task.env.observationNoise.{unread[0]}: expected one of {', '.join(parts)}"
        )
    least, most = settings.action_delay
    if least > most:
        raise ConfigError(
            f"task.env.actionDelay=[{least}, {most}]: expected [least, most] control steps"
        )
    if settings.is_deployable:
        return
    if settings.history_steps > 1:
        raise ConfigError(
            f"task.env.historySteps={settings.history_steps}: full observations have no history;"
            " add task.env.observations=deployable, or set it to 1"
        )
    if any(parts.values()):
        raise ConfigError(
            "task.env.observationNoise needs task.env.observations=deployable; noise on full"
            " observations is task.task.randomization_params.observations"
        )


class RobotAMP(HumanoidAMP):
    """A robot from a file, whose bodies, drives and start pose come from the model or from keys.

    Actions are offsets of PD targets from the start pose, and efforts are limited, unlike in
    HumanoidAMP. If `observations` is `deployable`, the policy observes frames of measured
    quantities (see `deployable_observations`), and an asymmetric critic observes the full state.
    Noise affects only the policy's frames. The AMP observation is the same as with full
    observations.

    Raises:
        ConfigError: a file or key is invalid (see `robots.load.load_robot`).
        MotionFileError: a clip is invalid or belongs to another robot.
    """

    settings_class = RobotAMPConfig
    default_asset = "mjcf/g1.xml"
    actor_name = "robot"
    num_dofs_of_assets = ()

    def read_settings(self, env: dict[str, Any]) -> RobotAMPConfig:
        """Check and return the keys of `task.env`, including those that depend on each other."""
        config: RobotAMPConfig = super().read_settings(env)
        check_realism(config, env)
        return config

    def build_model(self) -> mujoco.MjModel:
        """Return the model of the robot on a floor, and log what was derived from the file."""
        path = asset_path(self.env_cfg.asset, self.default_asset)
        self._robot = load_robot(path, self.env_cfg, "task.env")
        self._spec = self._robot.spec
        scale = f"actionScale: {self._action_scale_rad():.3g} rad"
        for line in (*self._robot.describe(), scale):
            log.info("%s", line)
        friction = self.env_cfg.plane.dynamic_friction
        model = compile_spec(self._spec, path, self.sim_cfg, friction, self.change_spec)
        set_actuators(model, self.env_cfg)
        # `model` may contain objects of the goal.
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
        """Whether bodies that touch the ground in the clips may touch it in episodes."""
        return not self.env_cfg.contact_bodies

    def reference_skeleton(self) -> Skeleton:
        """Return the robot's skeleton."""
        return self._skeleton

    def default_pose(self) -> tuple[Tensor, Tensor]:
        """Return root state (13,) and DOF positions (D,) in rad of the start pose, on the floor."""
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
        """Return the start pose (D,) and `actionScale` (D,) as offset and scale of PD targets."""
        offset = self.default_pose()[1].to(lower)
        return offset, torch.full_like(offset, self._action_scale_rad())

    def character_observation_groups(self) -> dict[str, int]:
        """Return the parts of the base observation, or of the policy's frames."""
        if not self.env_cfg.is_deployable:
            return super().character_observation_groups()
        return history_groups(self._layout.num_dofs, self.env_cfg.history_steps)

    def observation_frames(self) -> dict[str, str]:
        """Return the coordinate frames of the observation parts, including measured quantities."""
        measured = {"root_ang_vel_b": "base", "gravity_b": "base", "dof_pos_offset": "joint"}
        return super().observation_frames() | measured

    def states_size(self) -> int:
        """Return the dimension of the privileged observation (see `compute_states`)."""
        if not self.env_cfg.is_deployable:
            return super().states_size()
        own = self._num_amp_obs_per_step + self._layout.num_dofs + 1
        return own + self.get_task_obs_size()

    def allocate_buffers(self) -> None:
        """Add the policy's frames (N, H, F), newest first, and the action delay."""
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
        noise = asdict(cfg.observation_noise)
        if any(noise.values()):
            self._noise_widths = noise_widths(noise, num_dofs).to(self.device)
        least, most = cfg.action_delay
        if most > 0:
            self._delay = ActionDelay(least, most, n, self.num_actions, self.device)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Apply pushes that are due, then run the base method."""
        is_due = self.control_steps > 0 and self.control_steps % self.push_interval == 0
        if self.env_cfg.push_robots and is_due:
            largest = self.env_cfg.push_velocity
            change = uniform(self.reset_buf, -largest, largest, (2,))
            set_planar_velocities(self.simulation, self.simulation.root_states[:, 7:9] + change)
        super().pre_physics_step(actions)

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the PD targets of the delayed actions."""
        return super().compute_controls(actions if self._delay is None else self._delay(actions))

    def update_state(self) -> None:
        """Run the base method, and add the newest measurements to the history."""
        super().update_state()
        if self._frames is not None:
            push_newest(self._frames, self._measure(None, self.actions))

    def reset_state(self, env_ids: Tensor) -> None:
        """Run the base method, draw delays, and fill the history with the first measurement."""
        super().reset_state(env_ids)
        if self._delay is not None:
            self._delay.reset(env_ids)
        if self._frames is not None:
            first = self._measure(env_ids, torch.zeros_like(self.actions[env_ids]))
            first = first.unsqueeze(1).expand(-1, self._frames.shape[1], -1)
            self._frames.index_copy_(0, env_ids, first)

    def _measure(self, env_ids: Tensor | None, last_action: Tensor) -> Tensor:
        """Return noisy measurements of robots `env_ids` (n,). None selects all robots."""
        root_states, dof_pos, dof_vel, _ = self._character_states(env_ids)
        frame = compute_frame(root_states, dof_pos, dof_vel, self._start_dof_pos, last_action)
        return frame if self._noise_widths is None else add_noise(frame, self._noise_widths)

    def _observe_clip(self, states: CharacterState) -> Tensor | None:
        """Return None if the policy observes frames, because clips do not contain actions."""
        return super()._observe_clip(states) if self._frames is None else None

    def _observe_character(self, env_ids: Tensor | None) -> Tensor:
        if self._frames is None:
            return super()._observe_character(env_ids)
        frames = self._frames if env_ids is None else self._frames.index_select(0, env_ids)
        return frames.flatten(1)

    def compute_states(self, env_ids: Tensor | None, observations: Tensor) -> Tensor:
        """Return the privileged observations (n, numStates) of a `deployable` policy's critic.

        The privileged observations contain the full observation without noise, the clamped action
        of the last step (D), the action delay (1, control steps), and the goal.
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
        """Return one step of the AMP observation, for full and for `deployable` observations."""
        if self._frames is None:
            return super().current_amp_features(env_ids)
        if self.num_states == 0:
            return self._amp_features(self._character_states(env_ids))
        # The privileged observation starts with one step of the AMP observation.
        features = self.states_buf[:, : self._num_amp_obs_per_step]
        return features if env_ids is None else features.index_select(0, env_ids)


class RobotAMPVelocity(RobotAMP):
    """RobotAMP that follows velocity commands in the style of its clips.

    Raises:
        ConfigError: a setting is invalid, or commands need motion but no clip moves horizontally.
    """

    goal_class = Velocity
    goal: Velocity

    def create_sim(self) -> None:
        """Create the simulations, refuse clips that all stand, and warn of sideways motion."""
        super().create_sim()
        ranges = self.goal.settings.command_ranges
        if not any((*ranges.linear_x, *ranges.linear_y)):
            return
        fastest_m_s = self.motion_lib.fastest_clip_m_s()
        where = f"task.env.motion_file={self.env_cfg.motion_file}"
        if fastest_m_s < _STANDING_M_S:
            raise ConfigError(
                f"{where}: no clip moves along the ground (fastest: {fastest_m_s:.3f} m/s), but"
                " task.env.randomCommandVelocityRanges needs one; choose clips whose root moves"
            )
        roots = []
        for index in range(self.motion_lib.num_motions()):
            clip = self.motion_lib.get_motion(index)
            velocities = clip.linear_velocity_w[:, 0], clip.angular_velocity_w[:, 0]
            arrays = (clip.root_translation, clip.local_rotation[:, 0], *velocities)
            roots.append(torch.cat([torch.from_numpy(a).float() for a in arrays], dim=-1))
        forward_m_s, left_m_s, _ = self.goal.planar_motion(torch.cat(roots)).mean(0).tolist()
        if abs(left_m_s) > max(abs(forward_m_s), _STANDING_M_S):
            quarter = math.copysign(math.pi / 2, left_m_s)
            front_rad = self.goal.settings.forward_yaw_rad + quarter
            log.warning(
                "%s: the clips move to the left at %.2f m/s and forward at %.2f m/s; if the robot's"
                " front is not the x axis of its base, set task.env.forwardYaw=%.2f",
                *(where, left_m_s, forward_m_s, math.remainder(front_rad, 2 * math.pi)),
            )
