"""The goal `velocity`: walk, sidestep, turn and stand on command, in the style of the clips.

The commands, their keys and the reward kernels come from IsaacGymEnvs' Anymal, with two
differences. Velocities are in the heading frame, because a walking robot leans. The reward depends
on the mean velocity of the last second, because a reward of the present velocity would suppress the
natural sway of the hips.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.markers import ACTUAL_COLOUR, GO_COLOUR, Arrow, Marker
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.velocity_tracking import CommandRangesConfig, tracking_kernels
from isaacgymenvs_lite.tasks.goals.goal import ClipsAhead, GoalSettings, TimedGoal
from isaacgymenvs_lite.tasks.goals.planar import facing, turned
from isaacgymenvs_lite.utils.rotations import planar_motion
from isaacgymenvs_lite.utils.state import Stateful

log = logging.getLogger(__name__)

WINDOW_S = 1.0
"""Motion and commands are averaged over this duration (s), which is about one stride."""
# A robot stalls if it covers less than this share of the commanded distance in a second. Slower and
# more recent commands do not count, because a robot needs a few steps to start.
_STALLED_SHARE, _LEAST_COMMAND_M_S, _TIME_TO_GO_S = 0.3, 0.25, 1.5
_NUM_AHEAD = 8  # sampled times in the next second of a clip
# Each key changes one component of the command in one direction.
_STEERING = {
    **{"up": (0, 1.0), "down": (0, -1.0), "q": (1, 1.0)},
    **{"e": (1, -1.0), "left": (2, 1.0), "right": (2, -1.0)},
}
_KEY_STEPS = 5  # key presses from 0 to the limit of a range
_LEAST_ARROW_M = 0.05
_COMMANDED_HEIGHT_M, _ACTUAL_HEIGHT_M = 0.03, 0.15


def compute_planar_motion(root_states: Tensor, forward_yaw_rad: float = 0.0) -> Tensor:
    """Return `planar_motion` (n, 3) of `root_states` (n, 13), whose forward direction is turned.

    The forward direction is the root's heading rotated about z by `forward_yaw_rad`.
    """
    motion = planar_motion(root_states)
    if not forward_yaw_rad:
        return motion
    velocity = turned(math.cos(forward_yaw_rad), -math.sin(forward_yaw_rad), motion[:, :2])
    return torch.cat((velocity, motion[:, 2:]), dim=-1)


@dataclass(frozen=True, kw_only=True)
class GaitCommandRanges(CommandRangesConfig):
    """`task.env.randomCommandVelocityRanges`, in the heading frame."""

    linear_x: tuple[float, ...] = setting((0.0, 1.0), length=2)  # m/s, forward
    linear_y: tuple[float, ...] = setting((-0.3, 0.3), length=2)  # m/s, to the left
    yaw: tuple[float, ...] = setting((-1.0, 1.0), length=2)  # rad/s, to the left


@dataclass(frozen=True, kw_only=True)
class VelocitySettings(GoalSettings):
    """Keys of `task.env` for the goal `velocity`."""

    command_ranges: GaitCommandRanges = setting(
        GaitCommandRanges(), key="randomCommandVelocityRanges"
    )
    change_steps_min: int = setting(90, key="commandChangeStepsMin", minimum=1)
    change_steps_max: int = setting(210, key="commandChangeStepsMax", minimum=2)
    standing_share: float = setting(0.15, key="standingShare", minimum=0, maximum=1)
    forward_yaw_rad: float = setting(0.0, key="forwardYaw", minimum=-math.pi, maximum=math.pi)
    end_stalled: bool = setting(False, key="endStalled")
    lin_vel_xy_reward: float = setting(0.6, key="linearVelocityXYRewardScale", minimum=0)
    ang_vel_z_reward: float = setting(0.4, key="angularVelocityZRewardScale", minimum=0)


class MeanShortfall(Stateful):
    """The mean difference (N, C) between wanted and actual motion in the last second.

    `dt_s` is the duration of a control step.
    """

    def __init__(self, num_envs: int, num_values: int, dt_s: float, device: torch.device) -> None:
        # Differences in a ring buffer, and its number of valid rows.
        steps = max(1, round(WINDOW_S / dt_s))
        self._rows = torch.zeros(steps, num_envs, num_values, device=device)
        self._next = 0
        self._num_valid = torch.zeros(num_envs, dtype=torch.int64, device=device)

    def clear(self, env_ids: Tensor) -> None:
        """Forget the past of characters `env_ids` (n,)."""
        self._rows.index_fill_(1, env_ids, 0.0)
        self._num_valid.index_fill_(0, env_ids, 0)

    def add(self, shortfall: Tensor) -> None:
        """Store the differences (N, C) of a control step."""
        self._rows[self._next] = shortfall
        self._next = (self._next + 1) % len(self._rows)
        self._num_valid += 1

    def mean(self) -> Tensor:
        """Return the mean differences (N, C)."""
        count = self._num_valid.clamp(1, len(self._rows)).unsqueeze(-1)
        return self._rows.sum(0) / count


class Velocity(TimedGoal):
    """The goal `velocity`.

    Attributes:
        commands: (N, 3) forward velocity (m/s), velocity to the left (m/s), turn rate to the left
            (rad/s).

    Raises:
        ConfigError: a value is invalid, or a range is empty.
    """

    num_obs = 3
    obs_name = "command"
    key_help = (
        "up, down: faster, slower; left, right: turn; q, e: sideways; space: stop; space again:"
        " random commands"
    )
    settings_class = VelocitySettings
    look_ahead_s = tuple(WINDOW_S * i / _NUM_AHEAD for i in range(_NUM_AHEAD))
    change_steps_keys = ("commandChangeStepsMin", "commandChangeStepsMax")
    settings: VelocitySettings

    def __init__(self, env: Mapping[str, Any]) -> None:
        super().__init__(env)
        for name, (low, high) in asdict(self.settings.command_ranges).items():
            if low > high:
                raise ConfigError(
                    f"task.env.randomCommandVelocityRanges.{name}=[{low:g}, {high:g}]: expected"
                    " [lowest, highest]"
                )

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method and command all characters to stand."""
        super().attach(simulation, dt_s)
        n, device = simulation.num_envs, simulation.device
        self.commands = torch.zeros(n, 3, device=device)
        self._steered: list[float] | None = None  # the user's command
        self._shortfall = MeanShortfall(n, 3, dt_s, device)
        self._command_steps = torch.zeros(n, dtype=torch.int64, device=device)

    def _limits(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return the lowest and the highest command, (3,) each."""
        limits = torch.tensor(astuple(self.settings.command_ranges), device=device)
        return limits[:, 0], limits[:, 1]

    def planar_motion(self, root_states: Tensor) -> Tensor:
        """Return the motion (n, 3) of `root_states` (n, 13) (see `compute_planar_motion`)."""
        return compute_planar_motion(root_states, self.settings.forward_yaw_rad)

    def reset(self, env_ids: Tensor) -> None:
        """Run the base method and clear the errors of the previous episode."""
        super().reset(env_ids)
        self._shortfall.clear(env_ids)

    def draw(self, env_ids: Tensor) -> None:
        """Draw commands for `env_ids` (n,), or assign the command of a steering user."""
        n, device = len(env_ids), env_ids.device
        if self._steered is not None:
            commands = torch.tensor(self._steered, device=device).expand(n, 3)
        else:
            low, high = self._limits(device)
            stands = torch.rand(n, 1, device=device) < self.settings.standing_share
            commands = low + (high - low) * torch.rand(n, 3, device=device)
            commands = commands.masked_fill(stands, 0.0)
        self.commands.index_copy_(0, env_ids, commands)
        self._command_steps.index_fill_(0, env_ids, 0)

    def observe_clips(self, ahead: ClipsAhead) -> Tensor:
        """Return clips' mean motion (n, 3) in the next second, clamped to the command ranges."""
        root_states = ahead.root_states
        low, high = self._limits(root_states.device)
        motion = self.planar_motion(root_states.flatten(0, 1)).view(*root_states.shape[:2], 3)
        return torch.minimum(torch.maximum(motion.mean(1), low), high)

    def follow_clips(self, env_ids: Tensor, ahead: ClipsAhead) -> None:
        """Use the clips' mean velocity over the next second as the command, unless a user steers.

        With random commands only, a policy that stands earns more than one that tries first steps.
        """
        if self._steered is None:
            self.commands.index_copy_(0, env_ids, self.observe_clips(ahead))

    def on_key(self, key: str) -> None:
        """Change the first environment's command by a key, and give all environments this command.

        A command stays within the ranges. The command to stop is allowed if standing is trained.
        """
        low, high = self._limits(self.commands.device)
        if key in _STEERING:
            axis, sign = _STEERING[key]
            command = self.commands[0].clone()
            command[axis] += sign * max(abs(low[axis]), abs(high[axis])) / _KEY_STEPS
            self._steered = command.clamp(low, high).tolist()
        elif key == "space":
            stop = torch.zeros_like(low)
            if self.settings.standing_share == 0:
                stop = stop.clamp(low, high)
            self._steered = None if self._steered == stop.tolist() else stop.tolist()
        else:
            return
        self.draw(torch.arange(len(self.commands), device=self.commands.device))
        forward, left, turn = self.commands[0].tolist()
        log.info("command: forward %.2f m/s, left %.2f m/s, turn %.2f rad/s", forward, left, turn)

    def after_step(self) -> None:
        """Store the difference between the command and the motion of the step."""
        self._shortfall.add(self.commands - self.planar_motion(self.root_states()))
        self._command_steps += 1

    def failures(self, contact_body_ids: Tensor) -> Tensor | None:
        """Return which robots (N,) stall, or None if `endStalled` is False.

        Standing is a local optimum of training, because a standing robot never falls and nearly
        follows slow commands.
        """
        if not self.settings.end_stalled:
            return None
        commanded_m_s = torch.linalg.vector_norm(self.commands[:, :2], dim=-1)
        # This quotient is the missing share of the commanded distance.
        missing = (self._shortfall.mean()[:, :2] * self.commands[:, :2]).sum(dim=-1)
        stalls = missing > (1.0 - _STALLED_SHARE) * commanded_m_s.square()
        had_time = self._command_steps * self.dt_s >= _TIME_TO_GO_S
        return stalls & had_time & (commanded_m_s > _LEAST_COMMAND_M_S)

    def observe(self, env_ids: Tensor | None) -> Tensor:
        """Return the commands (n, 3)."""
        return self.rows(self.commands, env_ids)

    def reward(self) -> Terms:
        """Return the reward terms (N,) of the mean velocity and turn rate in the last second."""
        shortfall = self._shortfall.mean().t()
        along, turning = tracking_kernels(shortfall[:2], shortfall[2])
        cfg = self.settings
        return {
            "lin_vel_xy": cfg.lin_vel_xy_reward * along,
            "ang_vel_z": cfg.ang_vel_z_reward * turning,
        }

    def errors(self) -> dict[str, Tensor]:
        """Return the errors (N,) of the mean velocity (m/s) and of the mean turn rate (rad/s)."""
        mean = self._shortfall.mean()
        return {
            "velocity_error_m_s": torch.linalg.vector_norm(mean[:, :2], dim=-1),
            "turn_error_rad_s": mean[:, 2].abs(),
        }

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return arrows of the commanded and the actual velocity and turn rate.

        A velocity arrow starts at the feet and is 1 m long for 1 m/s. A turn arrow starts in front
        of the feet and is 1 m long for 1 rad/s.
        """
        root = self.root_states()[env_id : env_id + 1]
        yaw_rad = self.settings.forward_yaw_rad
        ahead = turned(math.cos(yaw_rad), math.sin(yaw_rad), facing(root[:, 3:7]))[0]
        to_left = torch.stack((-ahead[1], ahead[0]))
        arrows: list[Marker] = []
        for (forward, left, turn), height, colour in (
            (self.commands[env_id], _COMMANDED_HEIGHT_M, GO_COLOUR),
            (self.planar_motion(root)[0], _ACTUAL_HEIGHT_M, ACTUAL_COLOUR),
        ):
            for start, vector in (
                (root[0, :2], forward * ahead + left * to_left),
                (root[0, :2] + 0.5 * ahead, turn * to_left),
            ):
                if torch.linalg.vector_norm(vector) > _LEAST_ARROW_M:
                    (x, y), (to_x, to_y) = start.tolist(), (start + vector).tolist()
                    arrows.append(Arrow((x, y, height), (to_x, to_y, height), colour))
        return tuple(arrows)
