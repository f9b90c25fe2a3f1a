"""The ground under AnymalTerrain's robots, its friction, and pushes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.utils.rotations import quat_from_euler_xyz
from tests.tasks.anymal_terrain.conftest import (
    EXACT,
    SMALL,
    all_ids,
    put,
)

# --- ground ---------------------------------------------------------------------------------


def test_robots_stand_on_their_tile(make) -> None:
    for level in [0, 2]:
        task = make(*EXACT, num_envs=32)
        task.curriculum.levels[:] = level
        task.reset()
        sim = task.simulation
        origins = task.curriculum.origins(all_ids(task))
        assert origins[:, 0].tolist() == pytest.approx([8.0 * level + 4.0] * 32)
        assert set(origins[:, 1].tolist()) == {4.0, 12.0, 20.0, 28.0}
        if level == 2:
            assert len(set(origins[:, 2].tolist())) == 3  # a pit, stairs down, stairs up
        offset = sim.root_states[:, :3] - origins
        assert offset[:, 2].tolist() == pytest.approx([0.62] * 32, abs=1e-5)
        assert 0.4 < offset[:, :2].abs().max() <= 0.5
        task.step(task.zero_actions())
        assert not sim.contact_forces.any()
        for _ in range(100):
            *_, dones, _ = task.step(task.zero_actions())
            assert not dones.any()
        above = sim.root_states[:, 2] - origins[:, 2]
        assert 0.42 < above.min() <= above.max() < 0.543
        weight = sim.contact_forces[:, 3::3, 2].sum(1)
        assert weight.median().item() == pytest.approx(53.164 * 9.81, rel=0.02)


def test_observed_heights_are_those_of_the_ground(make) -> None:
    task = make(*EXACT, num_envs=24)
    task.curriculum.levels[:] = torch.arange(24) % 3
    task.reset()
    spread = torch.rand(24, 2) * torch.tensor([22.0, 30.0]) + 1.0
    yaw = 6.0 * torch.rand(24)
    pos = torch.cat((spread, torch.full((24, 1), 0.7)), dim=1)
    rot = quat_from_euler_xyz(torch.zeros(24), torch.zeros(24), yaw)
    put(task, pos=pos, rot=rot)
    heights = task.compute_obs()[:, 36:176]
    samples = task.terrain.samples.astype(float)
    for env in range(24):
        cos, sin = math.cos(yaw[env]), math.sin(yaw[env])
        for place, (ahead, aside) in ((0, (-0.8, -0.5)), (9, (-0.8, 0.5)), (139, (0.8, 0.5))):
            x = (spread[env, 0].item() + cos * ahead - sin * aside + 2.0) / 0.1
            y = (spread[env, 1].item() + sin * ahead + cos * aside + 2.0) / 0.1
            if min(x % 1, y % 1, 1 - x % 1, 1 - y % 1) < 1e-3:
                continue  # on the border of two squares
            ground = 0.005 * min(samples[int(x), int(y)], samples[int(x) + 1, int(y) + 1])
            expected = 5.0 * max(-1.0, min(1.0, 0.7 - 0.5 - ground))
            assert heights[env, place].item() == pytest.approx(expected, abs=1e-4)
    assert heights.unique().numel() > 20


def test_robots_differ_in_friction_which_is_averaged_with_the_grounds(make) -> None:
    task = make("task.env.learn.frictionRange=[0.5,1.25]", num_envs=150)
    model = task.simulation.model
    robot = np.flatnonzero(model.geom_bodyid > 0)
    friction = task.simulation.expand("geom_friction")[:, robot, 0]
    assert (friction == friction[:, :1]).all()  # all parts of a robot
    own = 2.0 * friction[:, 0] - 1.0
    assert own.min() >= 0.5
    assert own.max() <= 1.25
    assert len(np.unique(own[:100])) == 100
    assert (own[100:] == own[:50]).all()  # the buckets in turn
    # MuJoCo would take the larger of two coefficients, the ground's.
    floor = model.geom("floor").id
    assert task.simulation.expand("geom_friction")[:, floor, 0].max() < 1e-4
    same = make("task.env.learn.randomizeFriction=False")
    assert (same.simulation.model.geom_friction[:, 0] == 1.0).all()


# --- pushes ---------------------------------------------------------------------------------


def test_pushes_replace_the_velocity_over_the_ground(make) -> None:
    def velocities(pushes: bool) -> list[torch.Tensor]:
        task = make(
            *SMALL[1:],
            "task.env.learn.addNoise=False",
            f"task.env.learn.pushRobots={pushes}",
            "task.env.learn.pushInterval_s=0.06",
            num_envs=64,
        )
        task.reset()
        noted = []
        for _ in range(3):
            task.step(task.zero_actions())
            noted.append(task.simulation.root_states[:, 7:].clone())
        assert torch.allclose(task.compute_obs()[:, :3], 2.0 * task.base_motion().lin_vel.t())
        return noted

    pushed, free = velocities(True), velocities(False)
    assert torch.equal(pushed[0], free[0])
    assert torch.equal(pushed[1], free[1])
    over_ground = pushed[2][:, :2]
    assert -1.0 <= over_ground.min() < -0.9
    assert 0.9 < over_ground.max() <= 1.0
    # Replaced, not added: also the fall goes on, and so do the turns.
    assert torch.allclose(pushed[2][:, 2:], free[2][:, 2:], atol=1e-6)
    assert (pushed[2][:, :2] - free[2][:, :2]).abs().min(dim=1).values.median() > 0.05
