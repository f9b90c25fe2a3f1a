"""Reach: touch a point in space with a body, as in ASE's HumanoidReach."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.rendering.markers import GO_COLOUR, Marker, Sphere
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.goals.goal import (
    ClipsAhead,
    GoalSettings,
    PointGoal,
    check_range,
)
from isaacgymenvs_lite.tasks.goals.planar import in_heading_frame

_DISTANCE_SCALE = 4.0
_REACHING_BODIES = ("sword", "right_hand")
"""The first of these bodies that a character has is the default."""


def compute_reach_observations(root_states: Tensor, tar_pos: Tensor) -> Tensor:
    """Return points `tar_pos` (n, 3) m, rotated into the heading frame of `root_states` (n, 13).

    As in ASE, the root position is not subtracted from the world positions of the points.
    """
    return in_heading_frame(root_states[:, 3:7], tar_pos)


def compute_reach_reward(reach_body_pos: Tensor, tar_pos: Tensor) -> Tensor:
    """Return the reward (n,) in [0, 1] of nearness of bodies and points, both (n, 3) m."""
    return torch.exp(-_DISTANCE_SCALE * (tar_pos - reach_body_pos).square().sum(-1))


@dataclass(frozen=True)
class ReachSettings(GoalSettings):
    """Keys of `task.env` for the goal `reach`."""

    tar_speed: float = setting(1.0, key="tarSpeed", minimum=0)  # no effect
    change_steps_min: int = setting(50, key="tarChangeStepsMin", minimum=1)
    change_steps_max: int = setting(100, key="tarChangeStepsMax", minimum=2)
    tar_dist_max: float = setting(1.0, key="tarDistMax", above=0)  # m
    tar_height_min: float = setting(0.2, key="tarHeightMin")  # m
    tar_height_max: float = setting(2.0, key="tarHeightMax")  # m
    reach_body_name: str = setting("", key="reachBodyName")
    reach_obs_relative: bool = setting(False, key="reachObsRelative")


class Reach(PointGoal):
    """The goal `reach`."""

    num_obs = 3
    reached_m = 0.2
    look_ahead_s = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5)
    settings_class = ReachSettings
    settings: ReachSettings

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method, look up the body, and make the origin the initial goal."""
        cfg = self.settings
        check_range(
            "tarHeightMin", cfg.tar_height_min, "tarHeightMax", cfg.tar_height_max, equal=True
        )
        super().attach(simulation, dt_s)
        names = simulation.body_names
        name = cfg.reach_body_name or next((body for body in _REACHING_BODIES if body in names), "")
        if name not in names:
            raise ConfigError(unknown("task.env.reachBodyName", name, names))
        self._body, self._body_name = names.index(name), name
        self.tar_pos = torch.zeros(simulation.num_envs, 3, device=simulation.device)
        self._centre_w = torch.zeros(simulation.num_envs, 2, device=simulation.device)

    def reset(self, env_ids: Tensor) -> None:
        """Run the base method, with points around the places where the episodes begin.

        With `reachObsRelative: False` the points are around the origin, because the policy does not
        observe its own position in the world.
        """
        if self.settings.reach_obs_relative:
            self._centre_w.index_copy_(0, env_ids, self.root_states(env_ids)[:, :2])
        super().reset(env_ids)

    def draw(self, env_ids: Tensor) -> None:
        """Draw points around the centres of `env_ids` (n,)."""
        cfg = self.settings
        plane = self._centre_w[env_ids] + uniform(
            env_ids, -cfg.tar_dist_max, cfg.tar_dist_max, (2,)
        )
        height = uniform(env_ids, cfg.tar_height_min, cfg.tar_height_max, (1,))
        self.tar_pos.index_copy_(0, env_ids, torch.cat((plane, height), dim=-1))

    def observe_clips(self, ahead: ClipsAhead) -> Tensor | None:
        """Return observations (n, 3) of points that the body reaches in n clips."""
        points = self._points_of_clips(ahead)
        return None if points is None else self._observe(ahead.root_states[:, 0], points)

    def follow_clips(self, env_ids: Tensor, ahead: ClipsAhead) -> None:
        """Ask for points that the body reaches in the clips."""
        points = self._points_of_clips(ahead)
        if points is not None:
            self.tar_pos.index_copy_(0, env_ids, points)

    def _points_of_clips(self, ahead: ClipsAhead) -> Tensor | None:
        """Return where (n, 3) the body is at random times ahead. None: it is no key body."""
        positions = ahead.body_pos_w.get(self._body_name)
        if positions is None:
            return None
        rows = torch.arange(len(positions), device=positions.device)
        later = torch.randint(1, positions.shape[1], (len(positions),), device=positions.device)
        return positions[rows, later]

    def observe(self, env_ids: Tensor | None) -> Tensor:
        """See `compute_reach_observations`."""
        return self._observe(self.root_states(env_ids), self.rows(self.tar_pos, env_ids))

    def _observe(self, root: Tensor, point: Tensor) -> Tensor:
        if self.settings.reach_obs_relative:
            point = torch.cat((point[:, :2] - root[:, :2], point[:, 2:]), dim=-1)
        return compute_reach_observations(root, point)

    def reward(self) -> Tensor:
        """See `compute_reach_reward`."""
        return compute_reach_reward(self.simulation.body_pos[:, self._body], self.tar_pos)

    def distances(self) -> Tensor:
        """Return the distances (N,) m of the points from the body."""
        offsets = self.tar_pos - self.simulation.body_pos[:, self._body]
        return torch.linalg.vector_norm(offsets, dim=-1)

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return a sphere at the point."""
        x, y, z = self.tar_pos[env_id].tolist()
        return (Sphere((x, y, z), 0.08, GO_COLOUR),)
