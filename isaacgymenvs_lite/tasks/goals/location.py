"""Location: walk to a point on the ground, as in ASE's HumanoidLocation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.rendering.markers import GO_COLOUR, Marker, Sphere
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.goals.goal import ClipsAhead, GoalSettings, PointGoal
from isaacgymenvs_lite.tasks.goals.planar import (
    facing_reward,
    planar_velocity,
    speed_reward,
    xy_in_heading_frame,
)
from isaacgymenvs_lite.utils.rotations import normalize

_POSITION_SCALE, _SPEED_SCALE = 0.5, 4.0
_POSITION_WEIGHT, _SPEED_WEIGHT, _FACING_WEIGHT = 0.5, 0.4, 0.1
# Points of clips are where a clip is after this time, or up to so many times farther away.
_AHEAD_S, _FARTHER = 2.0, 2.0
_NEAR_M2 = 0.5  # within this squared distance the full reward for approach and facing is paid


def compute_location_observations(root_states: Tensor, tar_pos: Tensor) -> Tensor:
    """Return the offsets (n, 2) m of points `tar_pos` (n, 2) from the root, in its heading frame.

    `root_states` (n, 13) and `tar_pos` are in world axes.
    """
    return xy_in_heading_frame(root_states[:, 3:7], tar_pos - root_states[:, :2])


def compute_location_reward(
    root_pos: Tensor,
    prev_root_pos: Tensor,
    root_rot: Tensor,
    tar_pos: Tensor,
    tar_speed: float,
    dt: float,
) -> Tensor:
    """Return the reward (n,) in [0, 1] of being near the point, approaching it and facing it.

    The root positions (n, 3) before and after the control step and `tar_pos` (n, 2) are in m, in
    world axes. `root_rot` (n, 4) is xyzw, `tar_speed` is in m/s, and `dt` is in s.
    """
    offset = tar_pos - root_pos[:, :2]
    distance2 = offset.square().sum(-1)
    direction = normalize(offset, eps=1e-12)
    speed = (direction * planar_velocity(root_pos, prev_root_pos, dt)).sum(-1)
    near = distance2 < _NEAR_M2
    approach = speed_reward(speed, tar_speed, _SPEED_SCALE).masked_fill(near, 1.0)
    facing = facing_reward(root_rot, direction).masked_fill(near, 1.0)
    position = torch.exp(-_POSITION_SCALE * distance2)
    return _POSITION_WEIGHT * position + _SPEED_WEIGHT * approach + _FACING_WEIGHT * facing


@dataclass(frozen=True)
class LocationSettings(GoalSettings):
    """Keys of `task.env` for the goal `location`."""

    tar_speed: float = setting(1.0, key="tarSpeed", minimum=0)  # m/s
    change_steps_min: int = setting(100, key="tarChangeStepsMin", minimum=1)
    change_steps_max: int = setting(200, key="tarChangeStepsMax", minimum=2)
    tar_dist_max: float = setting(10.0, key="tarDistMax", above=0)  # m


class Location(PointGoal):
    """The goal `location`."""

    num_obs = 2
    reached_m = 0.5
    look_ahead_s = (0.0, _AHEAD_S)
    settings_class = LocationSettings
    settings: LocationSettings

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method, and make the origin the initial goal."""
        super().attach(simulation, dt_s)
        self.tar_pos = torch.zeros(simulation.num_envs, 2, device=simulation.device)

    def draw(self, env_ids: Tensor) -> None:
        """Draw points around the characters of `env_ids` (n,)."""
        reach = self.settings.tar_dist_max
        offset = uniform(env_ids, -reach, reach, (2,))
        self.tar_pos.index_copy_(0, env_ids, self.root_states(env_ids)[:, :2] + offset)

    def observe_clips(self, ahead: ClipsAhead) -> Tensor:
        """Return observations (n, 2) of points towards which n clips travel."""
        return compute_location_observations(ahead.root_states[:, 0], self._points_of_clips(ahead))

    def follow_clips(self, env_ids: Tensor, ahead: ClipsAhead) -> None:
        """Ask for points towards which the clips travel."""
        self.tar_pos.index_copy_(0, env_ids, self._points_of_clips(ahead))

    def _points_of_clips(self, ahead: ClipsAhead) -> Tensor:
        start, end = ahead.root_states[:, 0, :2], ahead.root_states[:, -1, :2]
        farther = 1.0 + (_FARTHER - 1.0) * torch.rand(len(start), 1, device=start.device)
        return start + farther * (end - start)

    def observe(self, env_ids: Tensor | None) -> Tensor:
        """See `compute_location_observations`."""
        goal = self.rows(self.tar_pos, env_ids)
        return compute_location_observations(self.root_states(env_ids), goal)

    def reward(self) -> Tensor:
        """See `compute_location_reward`."""
        root = self.root_states()
        return compute_location_reward(
            root[:, :3],
            self.prev_root_pos_w,
            root[:, 3:7],
            self.tar_pos,
            self.settings.tar_speed,
            self.dt_s,
        )

    def distances(self) -> Tensor:
        """Return the distances (N,) m of the points from the roots along the ground."""
        return torch.linalg.vector_norm(self.tar_pos - self.root_states()[:, :2], dim=-1)

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return a marker at the point, and an arrow to find a point outside of the picture."""
        x, y = self.tar_pos[env_id].tolist()
        direction = normalize(self.tar_pos[env_id] - self.root_states()[env_id, :2], eps=1e-12)
        point = Sphere((x, y, 0.0), math.sqrt(_NEAR_M2), GO_COLOUR)
        return (point, self.ground_arrow(env_id, direction, GO_COLOUR))
