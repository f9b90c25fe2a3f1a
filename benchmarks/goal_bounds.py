"""What a goal pays to a point that walks ahead at a constant speed, without legs and inertia.

    python -m benchmarks.goal_bounds [--speeds 1.3 1.6 2.8] [--turns 90 180 inf]

The point moves where it faces. Of `heading` it faces where going and facing together earn most, of
`location` the point on the ground, where it stops. If it turns at once (inf), no character earns
more that only walks ahead at this speed. With a number of degrees/s it rests until it has to turn
by less than 60 degrees: an estimate, no bound. Rewards and times are those of the tasks.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks import tables
from isaacgymenvs_lite.tasks.goals.heading import HeadingSettings, compute_heading_reward
from isaacgymenvs_lite.tasks.goals.location import LocationSettings, compute_location_reward
from isaacgymenvs_lite.utils.rotations import quat_from_angle_axis

_POINTS, _STEPS, _DT_S = 4096, 300, 1.0 / 30.0
_RESTS_RAD = math.pi / 3
_ARRIVED_M = 0.3
_DIRECTIONS = 90


def main() -> None:
    """Print the mean rewards per step."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--speeds", type=float, nargs="+", default=[1.3, 1.6, 2.8], help="m/s")
    turns = [90.0, 180.0, math.inf]
    parser.add_argument("--turns", type=float, nargs="+", default=turns, help="degrees/s")
    args = parser.parse_args()
    torch.manual_seed(1)
    rows = [
        (f"`{name}`", f"{speed:g}", *(f"{mean_reward(speed, turn):.3f}" for turn in args.turns))
        for name, mean_reward in (("heading", heading_reward), ("location", location_reward))
        for speed in args.speeds
    ]
    print(tables.markdown(("goal", "m/s", *(f"{turn:g} degrees/s" for turn in args.turns)), rows))


def heading_reward(speed: float, turn: float) -> float:
    """Return the mean reward of `heading`, at `speed` m/s and turning by `turn` degrees/s."""
    cfg = HeadingSettings()
    to_go, to_face = torch.zeros(_POINTS, 2), torch.zeros(_POINTS, 2)
    wanted = torch.empty(_POINTS).uniform_(cfg.tar_speed_min, cfg.tar_speed_max)
    best = torch.zeros(_POINTS)
    everyone = torch.arange(_POINTS)

    def earned(rows: Tensor, pos: Tensor, before: Tensor, rot: Tensor) -> Tensor:
        goal = to_go[rows], wanted[rows], to_face[rows]
        return compute_heading_reward(pos, before, rot, *goal, _DT_S)

    def reward(pos: Tensor, before: Tensor, rot: Tensor, aim: Tensor) -> Tensor:
        return earned(everyone, pos, before, rot)

    def draw(changes: Tensor, pos: Tensor) -> Tensor:
        for directions in (to_go, to_face):
            angles = 2 * math.pi * torch.rand(len(changes))
            directions[changes] = _unit(angles)[:, :2]
        # Each of them in each direction.
        angles = torch.arange(_DIRECTIONS) * (2 * math.pi / _DIRECTIONS)
        rows, ways = changes.repeat(_DIRECTIONS), angles.repeat_interleave(len(changes))
        start = pos[rows]
        of_ways = earned(rows, start + speed * _DT_S * _unit(ways), start, _rotation(ways))
        best[changes] = angles[of_ways.view(_DIRECTIONS, -1).argmax(dim=0)]
        return pos + 1e3 * _unit(best)

    steps = (cfg.change_steps_min, cfg.change_steps_max)
    return _mean_reward(speed, turn, steps, draw, reward)


def location_reward(speed: float, turn: float) -> float:
    """Return the mean reward of `location`, at `speed` m/s and turning by `turn` degrees/s."""
    cfg = LocationSettings()
    points = torch.zeros(_POINTS, 3)

    def reward(pos: Tensor, before: Tensor, rot: Tensor, aim: Tensor) -> Tensor:
        return compute_location_reward(pos, before, rot, aim[:, :2], cfg.tar_speed, _DT_S)

    def draw(changes: Tensor, pos: Tensor) -> Tensor:
        offsets = torch.empty(len(changes), 2).uniform_(-cfg.tar_dist_max, cfg.tar_dist_max)
        points[changes, :2] = pos[changes, :2] + offsets
        return points

    steps = (cfg.change_steps_min, cfg.change_steps_max)
    return _mean_reward(speed, turn, steps, draw, reward)


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
        draw: rows (k,) whose goals change, positions (n, 3) m -> the points (n, 3) to go to.
        reward: positions (n, 3) m after and before the step, rotations (n, 4) xyzw, points.
    """
    pos, heading = torch.zeros(_POINTS, 3), torch.zeros(_POINTS)
    change_at = torch.zeros(_POINTS, dtype=torch.int64)
    most = math.radians(turn) * _DT_S
    total, aim = 0.0, pos
    for step in range(_STEPS):
        changes = (change_at <= step).nonzero().flatten()
        if len(changes) > 0:
            aim = draw(changes, pos)
            change_at[changes] += torch.randint(*change_steps, (len(changes),))
        offset = aim - pos
        error = torch.atan2(offset[:, 1], offset[:, 0]) - heading
        error = torch.remainder(error + math.pi, 2 * math.pi) - math.pi
        heading = heading + error.clamp(-most, most)
        moves = ((error.abs() - most) < _RESTS_RAD) & (offset.norm(dim=-1) > _ARRIVED_M)
        before, pos = pos, pos + speed * _DT_S * moves[:, None] * _unit(heading)
        total += float(reward(pos, before, _rotation(heading), aim).mean())
    return total / _STEPS


def _unit(angles: Tensor) -> Tensor:
    """Return unit vectors (n, 3) in the plane, of angles (n,) rad."""
    return torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), dim=-1)


def _rotation(angles: Tensor) -> Tensor:
    """Return rotations (n, 4) xyzw about z by angles (n,) rad."""
    return quat_from_angle_axis(angles, torch.tensor([0.0, 0.0, 1.0]).expand(len(angles), 3))


if __name__ == "__main__":
    main()
