"""Ingenuity: formulas by hand, its forces, its targets, its ends."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from isaacgymenvs_lite.tasks.base.reward_terms import total
from isaacgymenvs_lite.tasks.ingenuity import (
    Ingenuity,
    compute_ingenuity_forces,
    compute_ingenuity_reward,
    draw_targets,
)

MakeTask = Callable[..., Ingenuity]
ROTATION = [0.102598, -0.205196, 0.307794, 0.923381]  # normalised (0.1, -0.2, 0.3, 0.9)
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
MASS_KG = 1.500117
GRAVITY_M_S2 = 3.721


def _reward(to_target: list[float], rot: list[float], spin: float) -> float:
    terms = compute_ingenuity_reward(
        torch.tensor([to_target]), torch.tensor([rot]), torch.tensor([spin])
    )
    return total(terms).item()


def test_reward_of_the_specification() -> None:
    # float32 of a rotation given with six digits
    assert _reward([-0.3, 0.4, -0.2], ROTATION, 0.5) == pytest.approx(5.228841, abs=8e-6)


def test_rewards_by_hand() -> None:
    assert _reward([0.0, 0.0, 0.0], UPRIGHT, 0.0) == pytest.approx(7.0)
    on_its_side = [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
    assert _reward([1.0, 0.0, 0.0], on_its_side, 2.0) == pytest.approx((1 + 2.5 + 0.2) / 2.0)


def test_forces_by_hand() -> None:
    actions = torch.tensor([[1.0, -1.0, 0.5, 0.1, 0.05, -1.0], [0.3, 0.1, 0.0, -0.2, 0.0, 3.0]])
    expected = [[2.0, -2.0, 10.0, -2.0, -1.0, -20.0], [0.0, 0.0, 0.0, -4.0, 0.0, 20.0]]
    torch.testing.assert_close(compute_ingenuity_forces(actions, 0.01), torch.tensor(expected))
    halved = compute_ingenuity_forces(actions, 0.005)
    torch.testing.assert_close(halved, torch.tensor(expected) / 2.0)


def test_the_model_is_that_of_the_tables(make_task: MakeTask) -> None:
    model = make_task("task=Ingenuity").simulation.model
    assert model.body("chassis").mass[0] == pytest.approx(0.0864)
    for rotor, height in enumerate((0.0, 0.025)):
        body = model.body(f"rotor_physics_{rotor}")
        assert body.mass[0] == pytest.approx(0.7069, abs=1e-4)
        assert body.pos.tolist() == [0.0, 0.0, height]
    assert model.body("chassis").subtreemass[0] == pytest.approx(MASS_KG, abs=1e-6)
    assert model.opt.gravity.tolist() == [0.0, 0.0, -GRAVITY_M_S2]
    assert model.opt.timestep == pytest.approx(0.005)


def _at_home(task: Ingenuity, rot: list[float]) -> None:
    task.reset()
    n = task.num_envs
    root = torch.tensor([[0.0, 0.0, 2.0, *rot, *[0.0] * 6]]).repeat(n, 1)
    nothing = torch.zeros(n, 0)
    task.simulation.write_state(torch.arange(n), root, nothing, nothing)


def test_half_the_weight_per_rotor_hovers(make_task: MakeTask) -> None:
    task = make_task("task=Ingenuity", num_envs=1)
    _at_home(task, UPRIGHT)
    share = MASS_KG * GRAVITY_M_S2 / 2.0 / 20.0
    assert share == pytest.approx(0.14, abs=0.001)
    for _ in range(200):
        task.reset_buf.zero_()
        task.step(torch.tensor([[0.0, 0.0, share, 0.0, 0.0, share]]))
    # 2 s at an acceleration of the sixth digit of gravity
    assert task.simulation.root_states[0, :3].tolist() == pytest.approx([0.0, 0.0, 2.0], abs=1e-4)


def test_forces_are_in_the_axes_of_the_body(make_task: MakeTask) -> None:
    """A body on its side, z along the world's x, is pulled along x and x's share along -z."""
    task = make_task("task=Ingenuity", "task.sim.gravity=[0,0,0]", num_envs=1)
    _at_home(task, [0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    task.step(torch.tensor([[0.1, 0.0, 0.5, 0.1, 0.0, 0.5]]))
    vel = task.simulation.root_states[0, 7:10]
    gained = 2.0 * 10.0 / MASS_KG * 0.01
    # The lateral forces turn it by some thousandths of a radian, about a centre 12 mm from here.
    assert vel[0].item() == pytest.approx(gained, rel=1e-2)
    assert vel[1].item() == pytest.approx(0.0, abs=1e-6)
    assert vel[2].item() == pytest.approx(-0.1 * gained, rel=2e-2)


def test_the_step_that_starts_an_episode_has_no_forces(make_task: MakeTask) -> None:
    task = make_task("task=Ingenuity", num_envs=2)
    task.reset()
    task.reset_buf[0] = 1
    task.step(torch.ones(2, 6))
    fallen, pushed = task.simulation.root_states[:, 9].tolist()
    assert fallen == pytest.approx(-GRAVITY_M_S2 * 0.01, rel=1e-4)
    assert pushed == pytest.approx((40.0 / MASS_KG - GRAVITY_M_S2) * 0.01, rel=1e-2)


def test_targets_are_five_metres_around_and_up_to_two_above() -> None:
    torch.manual_seed(0)
    targets = draw_targets(torch.arange(20000))
    for values, low, high in zip(
        targets.unbind(1), (-5.0, -5.0, 1.0), (5.0, 5.0, 2.0), strict=True
    ):
        # 20000 draws leave gaps of about 1/20000 of a range at its ends; standard error of the
        # mean: 0.2 % of the range.
        assert low <= values.min() < low + 0.001 * (high - low)
        assert high - 0.001 * (high - low) < values.max() <= high
        assert values.mean().item() == pytest.approx((low + high) / 2, abs=0.01 * (high - low))


def test_targets_change_every_500_steps_and_with_each_episode(make_task: MakeTask) -> None:
    task = make_task("task=Ingenuity", num_envs=5)
    assert task.target_pos.tolist() == [[0.0, 0.0, 1.0]] * 5
    task.reset()
    first = task.target_pos.clone()
    assert (first != torch.tensor([0.0, 0.0, 1.0])).all()
    task.progress_buf[:] = torch.tensor([0, 499, 500, 1500, 700])
    task.reset_buf[4] = 1
    task.step(torch.zeros(5, 6))
    assert (task.target_pos != first).any(1).tolist() == [False, False, True, True, True]
    second = task.target_pos.clone()
    task.reset_buf.zero_()
    task.step(torch.zeros(5, 6))
    # The one that was at 499 is due now.
    assert (task.target_pos != second).any(1).tolist() == [False, True, False, False, False]


def test_episodes_end_at_their_length_or_by_a_failure(make_task: MakeTask) -> None:
    task = make_task("task=Ingenuity", num_envs=5)
    task.reset()
    _at_home(task, UPRIGHT)
    task.target_pos[:] = torch.tensor([0.0, 0.0, 2.0])
    task.target_pos[3, 0], task.target_pos[4, 0] = 8.1, 7.9
    low = torch.tensor([[0.0, 0.0, 0.49, *UPRIGHT, *[0.0] * 6]])
    nothing = torch.zeros(1, 0)
    task.simulation.write_state(torch.tensor([2]), low, nothing, nothing)
    task.progress_buf[:] = torch.tensor([1997, 1998, 10, 10, 10])
    *_, dones, infos = task.step(torch.zeros(5, 6))
    assert dones.tolist() == [0, 1, 1, 1, 0]
    assert infos["time_outs"].tolist() == [False, True, False, False, False]
