"""Heading: walk in a direction at a speed, and face a direction, as in ASE's HumanoidHeading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.rendering.markers import FACE_COLOUR, GO_COLOUR, Marker
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.goals.goal import ClipsAhead, GoalSettings, TimedGoal, check_range
from isaacgymenvs_lite.tasks.goals.planar import (
    facing,
    facing_reward,
    planar_velocity,
    xy_in_heading_frame,
)
from isaacgymenvs_lite.utils.rotations import normalize

_VELOCITY_SCALE = 0.25
_TANGENT_SHARE = 0.1
_DIRECTION_WEIGHT, _FACING_WEIGHT = 0.7, 0.3
# A character is on course within these errors. Its velocity is averaged over about half a stride,
# because the root sways.
_ON_COURSE_M_S, _ON_COURSE_COS, _AVERAGE_S = 0.25, math.cos(math.radians(20.0)), 0.5
# A clip that is slower than this while `look_ahead_s` lasts counts as walking where it faces.
_LEAST_TRAVEL_M_S = 0.2


def compute_heading_observations(
    root_states: Tensor, tar_dir: Tensor, tar_speed: Tensor, tar_face_dir: Tensor
) -> Tensor:
    """Return the goal (n, 5) in the heading frame of the root: direction, speed, facing direction.

    `root_states` (n, 13) and the unit directions (n, 2) are in world axes, `tar_speed` (n,) is in
    m/s.
    """
    root_rot = root_states[:, 3:7]
    return torch.cat(
        (
            xy_in_heading_frame(root_rot, tar_dir),
            tar_speed.unsqueeze(-1),
            xy_in_heading_frame(root_rot, tar_face_dir),
        ),
        dim=-1,
    )


def compute_heading_reward(
    root_pos: Tensor,
    prev_root_pos: Tensor,
    root_rot: Tensor,
    tar_dir: Tensor,
    tar_speed: Tensor,
    tar_face_dir: Tensor,
    dt: float,
) -> Tensor:
    """Return the reward (n,) in [0, 1] of moving with the target velocity and facing the target.

    As in ASE, the lateral error is the sum of the components of the lateral velocity, although the
    length of this vector was probably intended. Positions (n, 3) before and after the control step
    are in m, and `root_rot` (n, 4) is xyzw. `tar_speed` (n,) is in m/s, directions are unit vectors
    (n, 2), and `dt` is in s.
    """
    velocity = planar_velocity(root_pos, prev_root_pos, dt)
    along = (tar_dir * velocity).sum(-1)
    across = (velocity - along.unsqueeze(-1) * tar_dir).sum(-1)
    error = (tar_speed - along).square() + _TANGENT_SHARE * across.square()
    direction = torch.exp(-_VELOCITY_SCALE * error).masked_fill(along <= 0.0, 0.0)
    return _DIRECTION_WEIGHT * direction + _FACING_WEIGHT * facing_reward(root_rot, tar_face_dir)


@dataclass(frozen=True)
class HeadingSettings(GoalSettings):
    """Keys of `task.env` for the goal `heading`."""

    tar_speed_min: float = setting(1.5, key="tarSpeedMin", minimum=0)  # m/s
    tar_speed_max: float = setting(1.6, key="tarSpeedMax", minimum=0)  # m/s
    change_steps_min: int = setting(100, key="headingChangeStepsMin", minimum=1)
    change_steps_max: int = setting(200, key="headingChangeStepsMax", minimum=2)
    enable_rand_heading: bool = setting(True, key="enableRandHeading")


class Heading(TimedGoal):
    """The goal `heading`."""

    num_obs = 5
    settings_class = HeadingSettings
    change_steps_keys = ("headingChangeStepsMin", "headingChangeStepsMax")
    look_ahead_s = (0.0, 0.2, 0.4, 0.6, 0.8)
    settings: HeadingSettings

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method, and command all characters to face and walk along +x at 1 m/s."""
        cfg = self.settings
        check_range("tarSpeedMin", cfg.tar_speed_min, "tarSpeedMax", cfg.tar_speed_max, equal=True)
        super().attach(simulation, dt_s)
        n, device = simulation.num_envs, simulation.device
        self.tar_speed = torch.ones(n, device=device)
        self.tar_dir = torch.tensor([1.0, 0.0], device=device).repeat(n, 1)
        self.tar_face_dir = self.tar_dir.clone()
        self._mean_vel_w = torch.zeros(n, 2, device=device)
        self._steps_on_course = torch.zeros(n, device=device)
        self._num_steps = torch.zeros(n, device=device)

    def reset(self, env_ids: Tensor) -> None:
        """Run the base method, and clear the time on course."""
        super().reset(env_ids)
        self._mean_vel_w[env_ids] = self.root_states(env_ids)[:, 7:9]
        self._steps_on_course.index_fill_(0, env_ids, 0.0)
        self._num_steps.index_fill_(0, env_ids, 0.0)

    def after_step(self) -> None:
        """Count the steps in which the character is on course."""
        root = self.root_states()
        self._mean_vel_w += (self.dt_s / _AVERAGE_S) * (root[:, 7:9] - self._mean_vel_w)
        error = self._mean_vel_w - self.tar_speed.unsqueeze(-1) * self.tar_dir
        faces = facing_reward(root[:, 3:7], self.tar_face_dir) > _ON_COURSE_COS
        self._steps_on_course += faces & (torch.linalg.vector_norm(error, dim=-1) < _ON_COURSE_M_S)
        self._num_steps += 1.0

    def successes(self) -> dict[str, Tensor]:
        """Return the shares (N,) of the time within 0.25 m/s and 20 degrees of the goal."""
        return {"on_course": self._steps_on_course / self._num_steps.clamp(min=1.0)}

    def draw(self, env_ids: Tensor) -> None:
        """Draw directions and speeds for `env_ids` (n,)."""
        cfg = self.settings
        reach = math.pi if cfg.enable_rand_heading else 0.0
        for directions in (self.tar_dir, self.tar_face_dir):
            angle = uniform(env_ids, -reach, reach)
            directions.index_copy_(0, env_ids, torch.stack((angle.cos(), angle.sin()), dim=-1))
        speed = uniform(env_ids, cfg.tar_speed_min, cfg.tar_speed_max)
        self.tar_speed.index_copy_(0, env_ids, speed)

    def observe_clips(self, ahead: ClipsAhead) -> Tensor:
        """Return observations (n, 5) of goals with the directions of n clips."""
        roots = ahead.root_states
        return compute_heading_observations(roots[:, 0], *self._goals_of_clips(roots))

    def follow_clips(self, env_ids: Tensor, ahead: ClipsAhead) -> None:
        """Ask for the directions in which the clips travel and face.

        Otherwise a policy that walks forward never tries to walk backward or aside, although this
        earns more if it is asked to face another way.
        """
        own = (self.tar_dir, self.tar_speed, self.tar_face_dir)
        for values, rows in zip(own, self._goals_of_clips(ahead.root_states), strict=True):
            values.index_copy_(0, env_ids, rows)

    def _goals_of_clips(self, root_states: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return directions (n, 2), speeds (n,) and facing directions (n, 2) of n clips.

        The clips' speeds are clamped to the range of the goals.
        """
        face_dir = facing(root_states[:, -1, 3:7])
        travel = root_states[:, :, 7:9].mean(1)
        speed = torch.linalg.vector_norm(travel, dim=-1)
        is_slow = (speed < _LEAST_TRAVEL_M_S).unsqueeze(-1)
        tar_dir = torch.where(is_slow, face_dir, normalize(travel))
        tar_speed = speed.clamp(self.settings.tar_speed_min, self.settings.tar_speed_max)
        return tar_dir, tar_speed, face_dir

    def observe(self, env_ids: Tensor | None) -> Tensor:
        """See `compute_heading_observations`."""
        goal = (self.tar_dir, self.tar_speed, self.tar_face_dir)
        rows = (self.rows(values, env_ids) for values in goal)
        return compute_heading_observations(self.root_states(env_ids), *rows)

    def reward(self) -> Tensor:
        """See `compute_heading_reward`."""
        root = self.root_states()
        return compute_heading_reward(
            root[:, :3],
            self.prev_root_pos_w,
            root[:, 3:7],
            self.tar_dir,
            self.tar_speed,
            self.tar_face_dir,
            self.dt_s,
        )

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return arrows of the walking and the facing direction."""
        return (
            self.ground_arrow(env_id, self.tar_dir[env_id], GO_COLOUR),
            self.ground_arrow(env_id, self.tar_face_dir[env_id], FACE_COLOUR),
        )
