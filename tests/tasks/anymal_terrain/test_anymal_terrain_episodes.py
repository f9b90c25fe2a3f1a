"""AnymalTerrain's commands, and how its episodes begin and end."""

from __future__ import annotations

import math

import pytest
import torch

from tests.tasks.anymal_terrain.conftest import EXACT, all_ids, lie_down, put, step_until_done

# --- commands -------------------------------------------------------------------------------


def test_commands_are_drawn_in_their_ranges_and_small_ones_are_none(make) -> None:
    task = make(num_envs=2000)
    task.reset()
    along, aside, _, heading = task.commands.unbind(-1)
    speed = torch.hypot(along, aside)
    none = speed == 0.0
    # A circle of 0.25 m/s within a square of 2 m/s: pi / 64 = 4.9 %.
    assert 0.03 < none.float().mean() < 0.07
    assert speed[~none].min() > 0.25
    assert not heading[none].any()
    for drawn, limit in ((along, 1.0), (aside, 1.0), (heading, 3.14)):
        assert -limit <= drawn.min() < -0.98 * limit
        assert 0.98 * limit < drawn.max() <= limit


def test_the_yaw_rate_leads_to_the_heading(make) -> None:
    for heading, commanded, rate in [
        (0.0, 1.0, 0.5),
        (1.0, 0.0, -0.5),
        (0.0, 3.0, 1.0),
        (3.0, -3.0, (2 * math.pi - 6.0) / 2),  # over the back, the shorter way
        (-3.0, 3.0, -(2 * math.pi - 6.0) / 2),
    ]:
        task = make(*EXACT)
        task.reset()
        task.commands[:, 3] = commanded
        half = heading / 2
        put(task, rot=[0.0, 0.0, math.sin(half), math.cos(half)], vel=0.0)
        task.update_state()
        assert task.commands[:, 2].tolist() == pytest.approx([rate] * 4, abs=1e-5)
        assert task.compute_obs()[:, 11].tolist() == pytest.approx([rate / 4] * 4, abs=1e-5)


# --- episodes -------------------------------------------------------------------------------


def test_the_step_that_ends_an_episode_returns_the_first_observation_of_the_next(make) -> None:
    task = make(*EXACT)
    task.reset()
    for _ in range(20):
        task.step(0.3 * torch.randn(4, 12))
    task.progress_buf[:] = torch.tensor([998, 5, 998, 5])
    commands = task.commands.clone()
    observed, _, dones, infos = task.step(0.3 * torch.randn(4, 12))
    assert dones.tolist() == infos["time_outs"].tolist() == [1, 0, 1, 0]
    assert task.progress_buf.tolist() == [0, 6, 0, 6]
    new = observed["obs"][[0, 2]]
    sim = task.simulation
    # At rest and upright, as the new state is: no velocity, gravity or heading of the last one.
    assert torch.allclose(new[:, :9], torch.tensor([0.0] * 8 + [-1.0]), atol=1e-6)
    assert (task.commands[[0, 2], 3] != commands[[0, 2], 3]).all()
    headings = task.commands[[0, 2], 3]
    assert torch.allclose(new[:, 11], 0.25 * (0.5 * headings).clamp(-1.0, 1.0), atol=1e-6)
    assert torch.equal(new[:, 12:24], sim.dof_pos[[0, 2]])
    assert (new[:, 36:176] > 0.55).all()
    assert not new[:, 176:].any()
    assert observed["obs"][[1, 3], 176:].any()
    # The next step is an ordinary one.
    *_, dones, infos = task.step(task.zero_actions())
    assert not dones.any()
    assert task.progress_buf.tolist() == [1, 7, 1, 7]


def test_the_first_step_of_a_new_episode_has_no_memory_of_the_last(make) -> None:
    task = make(*EXACT)
    task.reset()
    for _ in range(20):
        task.step(torch.randn(4, 12))
    task.progress_buf[:] = 998
    task.step(torch.full((4, 12), 3.0))
    start_vel = task.simulation.dof_vel.clone()
    task.step(task.zero_actions())
    assert not task.reward_terms["action_rate"].any()
    changes = (task.simulation.dof_vel - start_vel).square().sum(1)
    assert torch.allclose(task.reward_terms["joint_acc"], -0.0005 * 0.02 * changes)
    assert task.air_time_s.flatten().tolist() == pytest.approx([0.02] * 16)


def test_a_trunk_on_the_ground_ends_the_episode_and_is_no_time_out(make) -> None:
    task = make(*EXACT, "task.env.learn.terminalReward=-10", num_envs=1)
    task.reset()
    task.progress_buf[:] = 500
    lie_down(task)
    hold = (task.simulation.dof_pos - task.default_dof_pos) / 0.5
    _, rewards, _, infos = step_until_done(task, hold)
    assert not infos["time_outs"].any()
    assert task.reward_terms["terminal"].tolist() == pytest.approx([-0.2])
    others = sum(term for name, term in task.reward_terms.items() if name != "terminal")
    assert rewards.item() == pytest.approx(max(others.item(), 0.0) - 0.2, abs=1e-6)
    assert task.progress_buf.tolist() == [0]


def test_knees_end_an_episode_only_if_they_must_not_touch(make) -> None:
    for allowed in [True, False]:
        task = make(*EXACT, f"task.env.learn.allowKneeContacts={allowed}", num_envs=1)
        task.reset()
        pos = task.curriculum.origins(all_ids(task)) + torch.tensor([0.0, 0.0, 0.36])
        root = task.simulation.root_states.clone()
        root[:, :3], root[:, 7:] = pos, 0.0
        joints = torch.tensor([[0.0, 0.6, -2.4, 0.0, -0.6, 2.4] * 2])
        task.simulation.write_state(all_ids(task), root, joints, torch.zeros_like(joints))
        hold = (joints - task.default_dof_pos) / 0.5
        collided = False
        for _ in range(20):
            *_, dones, _ = task.step(hold)
            collided |= bool(task.reward_terms["collision"].min() < 0.0)
            if dones.any() or collided:
                break
        assert collided
        assert dones.tolist() == [int(not allowed)]
