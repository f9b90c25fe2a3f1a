"""Cartpole: formulas by hand, its mechanics, its ends."""

from __future__ import annotations

import math

import mujoco
import pytest
import torch

from isaacgymenvs_lite.tasks.cartpole import (
    compute_cartpole_failures,
    compute_cartpole_observations,
    compute_cartpole_reward,
)


def _column(*values: float) -> torch.Tensor:
    return torch.tensor(values)


def test_reward_of_the_specification() -> None:
    terms = compute_cartpole_reward(_column(0.2), _column(0.5), _column(-1.0), _column(0.0), 3.0)
    assert sum(terms.values()).item() == pytest.approx(0.9475, abs=1e-6)


def test_a_failure_costs_two_whatever_else_is() -> None:
    for angle, cart in [(1.6, 0.0), (-1.6, 0.0), (0.0, 3.1), (0.0, -3.1)]:
        terms = compute_cartpole_reward(
            _column(angle), _column(9.0), _column(9.0), _column(cart), 3.0
        )
        assert sum(terms.values()).item() == -2.0
        assert compute_cartpole_failures(_column(angle), _column(cart), 3.0).all()
    assert not compute_cartpole_failures(_column(1.57), _column(2.99), 3.0).any()


def test_order_of_the_observation() -> None:
    rows = compute_cartpole_observations(*(_column(v) for v in (1.0, 2.0, 3.0, 4.0)))
    assert rows.tolist() == [[1.0, 2.0, 3.0, 4.0]]


def test_the_model_is_that_of_the_tables(make_task) -> None:
    model = make_task("task=Cartpole").simulation.model
    pole = model.body("pole")
    assert model.body("cart").mass[0] == pole.mass[0] == pytest.approx(1.0)
    assert sorted(pole.inertia) == pytest.approx([0.000433, 0.083467, 0.083633], abs=1e-6)
    assert pole.ipos.tolist() == pytest.approx([0.0, 0.0, 0.47])
    assert model.opt.timestep == pytest.approx(0.0083)


def test_a_full_action_pushes_with_the_maximal_effort(make_task) -> None:
    task = make_task("task=Cartpole", "task.env.maxEffort=40")
    task.reset()
    n = task.num_envs
    task.simulation.write_state(
        torch.arange(n), torch.zeros(n, 13), torch.zeros(n, 2), torch.zeros(n, 2)
    )
    task.step(torch.tensor([[1.0], [-1.0], [0.5], [7.0]]))
    # The upright pole about its hinge: of its 1 kg, the cart feels m - (m l)^2 / (I + m l^2).
    inertia = 0.083633 + 0.47**2
    felt = 1.0 + 1.0 - 0.47**2 / inertia
    expected = 40.0 / felt * 0.0166
    speeds = task.simulation.dof_vel[:, 0].tolist()
    assert speeds == pytest.approx([expected, -expected, expected / 2, expected], rel=2e-2)


def test_energy_is_kept_without_control(make_task) -> None:
    """Nothing brakes the cart, the pole, or collides."""
    task = make_task("task=Cartpole", num_envs=1)
    task.reset()
    model = task.simulation.model
    data = mujoco.MjData(model)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    data.qpos[1] = 1.0
    mujoco.mj_forward(model, data)
    before = data.energy.sum()
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert data.qpos[1] != pytest.approx(1.0, abs=0.01)
    assert data.energy.sum() == pytest.approx(before, rel=1e-4)


def test_episodes_end_at_the_499th_step_and_start_near_the_middle(make_task) -> None:
    task = make_task("task=Cartpole", "task.env.resetDist=1000", num_envs=64)
    observed = task.reset()["obs"]
    assert observed[:, [0, 2]].abs().max() <= 0.1
    assert 0.1 < observed[:, [1, 3]].abs().max() <= 0.25
    task.progress_buf[:] = 497
    *_, dones, infos = task.step(task.zero_actions())
    assert not dones.any()
    *_, dones, infos = task.step(task.zero_actions())
    assert dones.all()
    assert infos["time_outs"].all()
    observed, *_, dones, infos = task.step(task.zero_actions())
    assert not dones.any()
    assert (task.progress_buf == 0).all()
    assert observed["obs"][:, 2].abs().max() <= 0.1


def test_a_fallen_pole_is_no_time_out(make_task) -> None:
    task = make_task("task=Cartpole")
    task.reset()
    task.progress_buf[:] = 498
    pos = torch.tensor([[0.0, math.pi / 2 + 0.1]]).repeat(4, 1)
    task.simulation.write_state(torch.arange(4), torch.zeros(4, 13), pos, torch.zeros(4, 2))
    _, rewards, dones, infos = task.step(task.zero_actions())
    assert dones.all()
    assert not infos["time_outs"].any()
    assert rewards.tolist() == [-2.0] * 4
