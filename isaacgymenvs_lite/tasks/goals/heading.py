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
from isaacgymenvs_lite.tasks.goals.goal import GoalSettings, TimedGoal, check_range
from isaacgymenvs_lite.tasks.goals.planar import (
    facing_reward,
    planar_velocity,
    xy_in_heading_frame,
)

_VELOCITY_SCALE = 0.25
_TANGENT_SHARE = 0.1
_DIRECTION_WEIGHT, _FACING_WEIGHT = 0.7, 0.3


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

    def draw(self, env_ids: Tensor) -> None:
        """Draw directions and speeds for `env_ids` (n,)."""
        cfg = self.settings
        reach = math.pi if cfg.enable_rand_heading else 0.0
        for directions in (self.tar_dir, self.tar_face_dir):
            angle = uniform(env_ids, -reach, reach)
            directions.index_copy_(0, env_ids, torch.stack((angle.cos(), angle.sin()), dim=-1))
        speed = uniform(env_ids, cfg.tar_speed_min, cfg.tar_speed_max)
        self.tar_speed.index_copy_(0, env_ids, speed)

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
