"""Prints the returns of an ideal mass point for the goals `heading` and `location`.

    python -m benchmarks.goal_bounds

After each change of the goal the point pauses and faces anywhere. Then it moves at a constant speed
and faces as the goal asks, without an error. Its return bounds characters that have this speed and
need this time to react.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.hierarchy import CONTROL_STEPS_PER_S
from isaacgymenvs_lite.tasks.goals.heading import HeadingSettings, compute_heading_reward
from isaacgymenvs_lite.tasks.goals.location import (
    Location,
    LocationSettings,
    compute_location_reward,
)
from isaacgymenvs_lite.utils.rotations import quat_from_angle_axis

POINTS, STEPS = 4096, 300
DT_S = 1.0 / CONTROL_STEPS_PER_S


class Changes:
    """Counts the control steps since goals of all points changed, from `low` to `high` - 1."""

    def __init__(self, low: int, high: int) -> None:
        self._range = (low, high)
        self.age = torch.zeros(POINTS, dtype=torch.long)
        self._length = torch.randint(low, high, (POINTS,))

    def step(self) -> Tensor:
        """Return whose goals (N,) change after this control step."""
        self.age += 1
        changed = self.age >= self._length
        self.age[changed] = 0
        self._length[changed] = torch.randint(*self._range, (int(changed.sum()),))
        return changed


def facing(direction: Tensor, is_random: Tensor) -> Tensor:
    """Return rotations (n, 4) xyzw that face along vectors (n, 2), or anywhere if `is_random`."""
    angle = torch.atan2(direction[:, 1], direction[:, 0])
    anywhere = torch.empty_like(angle).uniform_(-math.pi, math.pi)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(angle), 3)
    return quat_from_angle_axis(torch.where(is_random, anywhere, angle), up)


def heading_return(speed_m_s: float, pause_s: float) -> float:
    """Return the mean reward of `heading`, when the points face where they go."""
    cfg = HeadingSettings()
    changes = Changes(cfg.change_steps_min, cfg.change_steps_max)
    tar_speed = torch.empty(POINTS).uniform_(cfg.tar_speed_min, cfg.tar_speed_max)
    ahead, behind = torch.tensor([[1.0, 0.0]]).expand(POINTS, 2), torch.zeros(POINTS, 3)
    total = 0.0
    for _ in range(STEPS):
        pauses = changes.age * DT_S < pause_s
        now = torch.nn.functional.pad(ahead * ~pauses.unsqueeze(-1) * speed_m_s * DT_S, (0, 1))
        rot = facing(ahead, is_random=pauses)
        reward = compute_heading_reward(now, behind, rot, ahead, tar_speed, ahead, DT_S)
        total += reward.mean().item()
        changes.step()
    return total / STEPS


def location_return(speed_m_s: float, pause_s: float) -> tuple[float, float]:
    """Return the mean reward of `location`, and the share of the points that are reached."""
    cfg = LocationSettings()
    changes = Changes(cfg.change_steps_min, cfg.change_steps_max)
    pos = torch.zeros(POINTS, 3)
    goal = torch.empty(POINTS, 2).uniform_(-cfg.tar_dist_max, cfg.tar_dist_max)
    total, num_reached, num_goals = 0.0, 0, 0
    for _ in range(STEPS):
        offset = goal - pos[:, :2]
        distance = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
        direction = offset / distance.clamp(min=1e-9)
        pauses = changes.age * DT_S < pause_s
        step = distance.clamp(max=speed_m_s * DT_S) * ~pauses.unsqueeze(-1)
        before, pos = pos, pos + torch.nn.functional.pad(direction * step, (0, 1))
        rot = facing(direction, is_random=pauses)
        total += compute_location_reward(pos, before, rot, goal, cfg.tar_speed, DT_S).mean().item()
        left_m = torch.linalg.vector_norm(goal - pos[:, :2], dim=-1)
        changed = changes.step()
        num_goals += int(changed.sum())
        num_reached += int((left_m[changed] < Location.reached_m).sum())
        new = torch.empty(POINTS, 2).uniform_(-cfg.tar_dist_max, cfg.tar_dist_max)
        goal = torch.where(changed.unsqueeze(-1), pos[:, :2] + new, goal)
    return total / STEPS, num_reached / max(num_goals, 1)


def main() -> None:
    """Print the returns by speed and by pause."""
    torch.manual_seed(1)
    for pause_s in (0.0, 0.5, 1.0):
        for speed in (1.0, 1.5, 2.0, 3.0):
            found, reached = location_return(speed, pause_s)
            print(
                f"{speed:g} m/s after {pause_s:g} s: heading {heading_return(speed, pause_s):.2f},"
                f" location {found:.2f} (reached {reached:.2f})"
            )


if __name__ == "__main__":
    main()
