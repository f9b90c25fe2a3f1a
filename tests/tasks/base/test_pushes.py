"""Pushes change the velocities over the ground, and nothing else."""

from __future__ import annotations

import torch

from isaacgymenvs_lite.tasks.base.pushes import push_interval, set_planar_velocities


def test_intervals_are_whole_control_steps():
    for interval_s, steps in [(1.0, 30), (0.05, 2), (0.001, 1)]:
        assert push_interval(interval_s, 1 / 30) == steps


def test_a_push_leaves_pose_joints_and_objects_as_they_are(make_task):
    task = make_task("task=HumanoidStrike", "task.env.motion_file=stand", "seed=3")
    task.reset()
    for _ in range(3):
        task.step(torch.rand(4, task.num_actions) - 0.5)
    sim = task.simulation
    objects = sim.object_states.clone()
    objects[..., 0] += 1.0  # away from where they start
    sim.write_object_states(torch.arange(4), torch.tensor([0]), objects)
    before = [state.clone() for state in (sim.root_states, sim.dof_pos, sim.dof_vel)]
    velocities = torch.tensor([[1.0, -1.0], [0.5, 0.0], [0.0, 0.0], [-2.0, 3.0]])
    set_planar_velocities(sim, velocities)
    assert torch.equal(sim.root_states[:, 7:9], velocities)
    before[0][:, 7:9] = velocities
    for now, then in zip((sim.root_states, sim.dof_pos, sim.dof_vel), before, strict=True):
        # exponential maps of ball joints go through quaternions
        torch.testing.assert_close(now, then, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(sim.object_states, objects)
