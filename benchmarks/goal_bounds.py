"""What a goal pays at most to a point that walks ahead: no legs, no balance, no inertia.

    python -m benchmarks.goal_bounds [--speeds 1.3 1.6 2.8] [--turns 90 180 inf]

The point goes where it faces, at a constant speed in m/s, and turns towards its goal by a number of
degrees/s. While it has to turn by more than 60 degrees it stays where it is; at a `location` it
stops. The rewards and the times of the goals are those of the tasks. A character that only walks
ahead cannot earn more than a point as fast as itself; one that walks sideways and backwards can.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.goals.heading import HeadingSettings, compute_heading_reward
from isaacgymenvs_lite.tasks.goals.location import LocationSettings, compute_location_reward

_POINTS, _STEPS, _DT_S = 4096, 300, 1.0 / 30.0
_STAYS_RAD = math.pi / 3
_ARRIVED_M = 0.3


def main() -> None:
    """Print the mean rewards per step."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--speeds", type=float, nargs="+", default=[1.3, 1.6, 2.8], help="m/s")
    turns = [90.0, 180.0, math.inf]
    parser.add_argument("--turns", type=float, nargs="+", default=turns, help="degrees/s")
    args = parser.parse_args()
    torch.manual_seed(1)
    head = " | ".join(f"{turn:g} degrees/s" for turn in args.turns)
    print(f"| goal | m/s | {head} |\n|---|---|{'---|' * len(args.turns)}")
    for name in BOUNDS:
        for speed in args.speeds:
            row = (f"{BOUNDS[name](speed, turn):.3f}" for turn in args.turns)
            print(f"| `{name}` | {speed:g} | {' | '.join(row)} |")


def heading_bound(speed: float, turn: float) -> float:
    """Return the mean reward of `heading`, which also wants another facing, for the point."""
    cfg = HeadingSettings()
    to_go, to_face = torch.zeros(_POINTS, 2), torch.zeros(_POINTS, 2)
    wanted = torch.empty(_POINTS).uniform_(cfg.tar_speed_min, cfg.tar_speed_max)

    def draw(changes: Tensor, pos: Tensor) -> Tensor:
        for directions in (to_go, to_face):
            angles = 2 * math.pi * torch.rand(len(changes))
            directions[changes] = torch.stack((angles.cos(), angles.sin()), dim=-1)
        return pos + 1e3 * to_go

    def reward(pos: Tensor, before: Tensor, rot: Tensor, aim: Tensor) -> Tensor:
        return compute_heading_reward(pos, before, rot, to_go, wanted, to_face, _DT_S)

    steps = (cfg.change_steps_min, cfg.change_steps_max)
    return _mean_reward(speed, turn, steps, draw, reward)


def location_bound(speed: float, turn: float) -> float:
    """Return the mean reward of `location` for the point."""
    cfg = LocationSettings()
    points = torch.zeros(_POINTS, 2)

    def draw(changes: Tensor, pos: Tensor) -> Tensor:
        offsets = torch.empty(len(changes), 2).uniform_(-cfg.tar_dist_max, cfg.tar_dist_max)
        points[changes] = pos[changes] + offsets
        return points

    def reward(pos: Tensor, before: Tensor, rot: Tensor, aim: Tensor) -> Tensor:
        return compute_location_reward(pos, before, rot, aim, cfg.tar_speed, _DT_S)

    steps = (cfg.change_steps_min, cfg.change_steps_max)
    return _mean_reward(speed, turn, steps, draw, reward)


BOUNDS = {"heading": heading_bound, "location": location_bound}


def _mean_reward(
    speed: float,
    turn: float,
    change_steps: tuple[int, int],
    draw: Callable[[Tensor, Tensor], Tensor],
    reward: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
) -> float:
    """Return the mean over 4096 points and 300 control steps.

    Args:
        speed: m/s.
        turn: degrees/s.
        change_steps: as the goal's keys: least number of steps, and above the largest one.
        draw: rows (k,) whose goals change, positions (n, 2) m -> the points (n, 2) to go to.
        reward: positions (n, 3) m after and before the step, rotations (n, 4) xyzw, points.
    """
    pos, heading = torch.zeros(_POINTS, 2), torch.zeros(_POINTS)
    change_at = torch.zeros(_POINTS, dtype=torch.int64)
    total, aim = 0.0, pos
    for step in range(_STEPS):
        changes = (change_at <= step).nonzero().flatten()
        if len(changes) > 0:
            aim = draw(changes, pos)
            change_at[changes] += torch.randint(*change_steps, (len(changes),))
        offset = aim - pos
        error = torch.atan2(offset[:, 1], offset[:, 0]) - heading
        error = torch.remainder(error + math.pi, 2 * math.pi) - math.pi
        most = math.radians(turn) * _DT_S
        heading = heading + error.clamp(-most, most)
        goes = ((error.abs() - most) < _STAYS_RAD) & (offset.norm(dim=-1) > _ARRIVED_M)
        facing = torch.stack((heading.cos(), heading.sin()), dim=-1)
        before, pos = pos, pos + speed * _DT_S * goes[:, None] * facing
        zeros = torch.zeros_like(heading)
        rot = torch.stack((zeros, zeros, (heading / 2).sin(), (heading / 2).cos()), dim=-1)
        total += float(reward(_lifted(pos), _lifted(before), rot, aim).mean())
    return total / _STEPS


def _lifted(pos: Tensor) -> Tensor:
    return torch.cat((pos, torch.zeros(len(pos), 1)), dim=-1)


if __name__ == "__main__":
    main()
