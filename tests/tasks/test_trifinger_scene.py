"""Trifinger's cube on the table, within the boundary."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from isaacgymenvs_lite.tasks.trifinger import Trifinger

MakeTask = Callable[..., Trifinger]
FARTHEST_M = 0.195 - 0.0325 * math.sqrt(3.0)


@pytest.fixture
def push(make_task: MakeTask) -> Callable[..., torch.Tensor]:
    """Return `push(starts, forces, steps)` -> (steps, N, 3), the places of pushed cubes.

    The places where the cubes start (N, 2) m and the forces (N, 2) N are along x and y. The fingers
    hold their default pose, away from the cubes.
    """

    def run(starts: torch.Tensor, forces: torch.Tensor, steps: int) -> torch.Tensor:
        n = len(starts)
        overrides = ("task.task.randomize=False", "task.env.command_mode=position")
        task = make_task("task=Trifinger", *overrides, num_envs=n)
        task.reset()
        states = torch.zeros(n, 1, 13)
        states[:, 0, :2], states[:, 0, 2], states[:, 0, 6] = starts, 0.0325, 1.0
        task.simulation.write_object_states(torch.arange(n), torch.tensor([0]), states)
        default, low, high = (
            torch.tensor(p * 3) for p in ([0, 0.9, -2], [-0.33, 0, -2.7], [1, 1.57, 0])
        )
        hold = (2.0 * default - low - high) / (high - low)
        places = []
        for _ in range(steps):
            pushes = torch.nn.functional.pad(forces, (0, 1))[:, None]
            task.simulation.apply_forces(("object",), pushes)
            task.step(hold.expand(n, 9))
            places.append(task.simulation.object_states[:, 0, :3].clone())
        return torch.stack(places)

    return run


def test_the_boundary_keeps_a_pushed_cube(push: Callable[..., torch.Tensor]) -> None:
    angles = math.pi / 12.0 * torch.arange(24)  # the middle of each of 24 boxes
    ways = torch.stack((angles.cos(), angles.sin()), dim=-1)
    places = push(FARTHEST_M * ways, 3.0 * ways, 100)  # from the farthest starts of episodes
    radius, height = places[..., :2].norm(dim=-1), places[..., 2]
    # The wall opens from 0.195 m to 0.281 m at a height of 0.175 m; a cube is 0.0325 m thick.
    assert (radius < 0.195 + 0.086 / 0.175 * height - 0.0225).all()
    assert height.min() > 0.03 and height.max() < 0.16
    assert (radius[-1] > FARTHEST_M + 0.02).all()


def test_a_cube_rests_on_the_table_and_slides_with_its_friction(
    push: Callable[..., torch.Tensor], make_task: MakeTask
) -> None:
    model = make_task("task=Trifinger", "task.task.randomize=False").simulation.model
    assert model.geom("table").friction[0] == pytest.approx(0.55)
    forces = torch.tensor([[0.0, 0.0], [0.4, 0.0], [0.6, 0.0]])
    places = push(torch.zeros(3, 2), forces, 20)
    # Contacts give way by a fraction of a millimetre.
    resting = torch.tensor([0.0, 0.0, 0.0325]).expand(20, 3)
    torch.testing.assert_close(places[:, 0], resting, atol=2e-4, rtol=0.0)
    slid = 0.5 * (0.6 / (291.3 * 0.065**3) - 0.55 * 9.81) * 0.4**2
    # Soft friction lets a cube creep by millimetres.
    assert places[-1, :, 0].tolist() == pytest.approx([0.0, 0.0, slid], abs=5e-3)
