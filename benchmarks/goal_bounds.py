"""Prints what a point earns that does nothing wrong but needs time to turn.

    python -m benchmarks.goal_bounds

The point rests for a while after each change of the goal `heading` or `location`. After that it
moves with a constant speed, and without an error, as the goal asks. Its return is a bound for
characters that move as fast and turn as quickly.
"""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.hierarchy import CONTROL_STEPS_PER_S
from isaacgymenvs_lite.tasks.goals.heading import HeadingSettings, compute_heading_reward
from isaacgymenvs_lite.tasks.goals.location import (
    Location,
    LocationSettings,
    compute_location_reward,
)

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


def facing_along(direction: Tensor) -> Tensor:
    """Return the root rotations (n, 4) xyzw that face along unit vectors (n, 2)."""
    half = torch.atan2(direction[:, 1], direction[:, 0]) / 2.0
    zero = torch.zeros_like(half)
    return torch.stack((zero, zero, half.sin(), half.cos()), dim=-1)


def heading_return(speed_m_s: float, rest_s: float) -> float:
    """Return the mean reward of `heading` for points that then also face as they are asked to."""
    cfg = HeadingSettings()
    changes = Changes(cfg.change_steps_min, cfg.change_steps_max)
    tar_speed = torch.empty(POINTS).uniform_(cfg.tar_speed_min, cfg.tar_speed_max)
    ahead, behind = torch.tensor([[1.0, 0.0]]).expand(POINTS, 2), torch.zeros(POINTS, 3)
    total = 0.0
    for _ in range(STEPS):
        moves = (changes.age * DT_S >= rest_s).unsqueeze(-1)
        now = torch.nn.functional.pad(ahead * moves * speed_m_s * DT_S, (0, 1))
        # While a point rests, it faces aside on average.
        rot = facing_along(torch.where(moves, ahead, ahead.flip(-1)))
        reward = compute_heading_reward(now, behind, rot, ahead, tar_speed, ahead, DT_S)
        total += reward.mean().item()
        changes.step()
    return total / STEPS


def location_return(speed_m_s: float, rest_s: float) -> tuple[float, float]:
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
        moves = (changes.age * DT_S >= rest_s).unsqueeze(-1)
        step = torch.minimum(distance, torch.tensor(speed_m_s * DT_S)) * moves
        before, pos = pos, pos + torch.nn.functional.pad(direction * step, (0, 1))
        rot = facing_along(torch.where(moves, direction, direction.flip(-1)))
        total += compute_location_reward(pos, before, rot, goal, cfg.tar_speed, DT_S).mean().item()
        left_m = torch.linalg.vector_norm(goal - pos[:, :2], dim=-1)
        changed = changes.step()
        num_goals += int(changed.sum())
        num_reached += int((left_m[changed] < Location.reached_m).sum())
        new = torch.empty(POINTS, 2).uniform_(-cfg.tar_dist_max, cfg.tar_dist_max)
        goal = torch.where(changed.unsqueeze(-1), pos[:, :2] + new, goal)
    return total / STEPS, num_reached / max(num_goals, 1)


def main() -> None:
    """Print the returns by speed and by the time that a change takes."""
    torch.manual_seed(1)
    for rest_s in (0.0, 0.5, 1.0):
        for speed in (1.0, 1.5, 2.0, 3.0):
            found, reached = location_return(speed, rest_s)
            print(
                f"{speed:g} m/s after {rest_s:g} s: heading {heading_return(speed, rest_s):.2f},"
                f" location {found:.2f} (reached {reached:.2f})"
            )


if __name__ == "__main__":
    main()
