"""Quadcopter: formulas by hand, its mechanics, its ends."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.tasks.base.hover import (
    compute_flight_failures,
    compute_flight_observations,
)
from isaacgymenvs_lite.tasks.base.reward_terms import total
from isaacgymenvs_lite.tasks.quadcopter import Quadcopter, compute_quadcopter_reward

MakeTask = Callable[..., Quadcopter]
ROTATION = [0.102598, -0.205196, 0.307794, 0.923381]  # normalised (0.1, -0.2, 0.3, 0.9)
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
WEIGHT_N = 0.251537 * 9.81
ARM_M = 0.1025 + 0.0425


def _reward(to_target: list[float], rot: list[float], spin: float) -> float:
    terms = compute_quadcopter_reward(
        torch.tensor([to_target]), torch.tensor([rot]), torch.tensor([spin])
    )
    return total(terms).item()


def test_reward_of_the_specification() -> None:
    # float32 of a rotation given with six digits
    assert _reward([-0.3, 0.4, -0.2], ROTATION, 0.5) == pytest.approx(2.162047, abs=3e-6)


def test_rewards_by_hand() -> None:
    assert _reward([0.0, 0.0, 0.0], UPRIGHT, 0.0) == pytest.approx(3.0)
    on_its_side, upside_down = [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], [0.0, 1.0, 0.0, 0.0]
    assert _reward([0.0, 0.0, 0.0], on_its_side, 0.0) == pytest.approx(1.0 + 1.0 / 2.0 + 1.0)
    assert _reward([0.0, 0.0, 0.0], upside_down, -3.0) == pytest.approx(1.0 + 1.0 / 5.0 + 1.0 / 10)
    assert _reward([0.0, 2.0, 0.0], UPRIGHT, 0.0) == pytest.approx(3.0 / 5.0)


def test_scales_of_the_observation() -> None:
    root = torch.arange(13.0)[None]
    observed = compute_flight_observations(torch.tensor([[3.0, -6.0, 1.5]]), root)[0]
    ways, rates = [1.0, -2.0, 0.5], [10 / math.pi, 11 / math.pi, 12 / math.pi]
    assert observed.tolist() == pytest.approx([*ways, 3, 4, 5, 6, 3.5, 4.0, 4.5, *rates])


def test_failures_by_hand() -> None:
    for to_target, height, failed in [
        ([2.9, 0.0, 0.0], 1.0, False),
        ([2.2, 2.2, 0.0], 1.0, True),
        ([0.0, 0.0, 0.69], 0.31, False),
        ([0.0, 0.0, 0.71], 0.29, True),
    ]:
        found = compute_flight_failures(torch.tensor([to_target]), torch.tensor([height]), 3.0, 0.3)
        assert found.item() == failed


def test_the_model_is_that_of_the_tables(make_task: MakeTask) -> None:
    task = make_task("task=Quadcopter")
    model = task.simulation.model
    assert model.body("chassis").mass[0] == pytest.approx(0.04712, abs=1e-5)
    for rotor, degrees in enumerate((45.0, 135.0, 225.0, 315.0)):
        assert model.body(f"rotor_arm{rotor}").mass[0] == pytest.approx(0.000838, abs=1e-6)
        assert model.body(f"rotor{rotor}").mass[0] == pytest.approx(0.05027, abs=1e-5)
        for kind, axis in (("pitch", [0, 1, 0]), ("roll", [1, 0, 0])):
            joint = model.joint(f"rotor_{kind}{rotor}")
            assert np.degrees(joint.range) == pytest.approx([-30.0, 30.0])
            assert joint.axis.tolist() == axis
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        angle = math.radians(degrees)
        place = [ARM_M * math.cos(angle), ARM_M * math.sin(angle), 1.0]
        assert data.body(f"rotor{rotor}").xpos == pytest.approx(place)
        along = data.body(f"rotor{rotor}").xmat[[0, 3, 6]]
        assert along == pytest.approx([math.cos(angle), math.sin(angle), 0.0])
    assert model.body("chassis").subtreemass[0] == pytest.approx(0.2515, abs=1e-4)
    assert task.simulation.dof_names == tuple(
        f"rotor_{kind}{rotor}" for rotor in range(4) for kind in ("pitch", "roll")
    )
    assert model.opt.timestep == pytest.approx(0.005)
    robot = model.geom_bodyid > 0
    assert (model.geom_contype[robot] == 0).all()  # parts do not touch each other,
    assert (model.geom_conaffinity[robot] == 1).all()  # but the ground


def _fly(task: Quadcopter, steps: int, targets: list[float], thrust: float) -> torch.Tensor:
    """Start at home with joints at targets (8,), hold targets and thrust (N), return the state."""
    task.reset()
    n = task.num_envs
    root = torch.tensor([[0.0, 0.0, 1.0, *UPRIGHT, *[0.0] * 6]]).repeat(n, 1)
    pos = torch.tensor([targets]).repeat(n, 1)
    task.simulation.write_state(torch.arange(n), root, pos, torch.zeros_like(pos))
    task.targets[:], task.thrusts[:] = pos, thrust
    for _ in range(steps):
        task.step(torch.zeros(n, 12))
    return task.simulation.root_states[0].double()


def test_a_quarter_of_the_weight_per_rotor_hovers(make_task: MakeTask) -> None:
    state = _fly(make_task("task=Quadcopter", num_envs=1), 200, [0.0] * 8, WEIGHT_N / 4)
    # 2 s at an acceleration of the sixth digit of the weight
    assert state[:3].tolist() == pytest.approx([0.0, 0.0, 1.0], abs=1e-4)
    assert state[3:7].tolist() == pytest.approx(UPRIGHT, abs=1e-6)


def test_thrust_is_along_the_axes_of_the_tilted_rotors(make_task: MakeTask) -> None:
    """All rotors are rolled alike about their arms: together they turn the body."""
    task = make_task("task=Quadcopter", num_envs=1)
    roll, thrust, steps = 0.1, WEIGHT_N / 4, 20
    state = _fly(task, steps, [0.0, roll] * 4, thrust)
    model = task.simulation.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertias = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertias)
    torque = -4.0 * thrust * math.sin(roll) * ARM_M
    # The rotors' roll changes the inertia by less than a hundredth.
    spin = torque / inertias[5, 5] * steps * 0.01
    assert state[12].item() == pytest.approx(spin, rel=1e-2)
    assert state[10:12].abs().max() < 1e-6
    sinking = 9.81 * (1.0 - math.cos(roll)) * steps * 0.01
    assert state[9].item() == pytest.approx(-sinking, rel=1e-2)


def test_actions_move_targets_and_thrusts_within_their_limits(make_task: MakeTask) -> None:
    task = make_task("task=Quadcopter", num_envs=2)
    task.reset()
    task.targets.zero_()
    actions = torch.tensor([[1.0, -1.0, 0.5, *[0.0] * 5, 0.25, -1.0, 0.0, 1.0]]).repeat(2, 1)
    task.step(actions)
    step = 0.08 * math.pi
    assert task.targets[0].tolist() == pytest.approx([step, -step, step / 2, *[0.0] * 5])
    assert task.thrusts[0].tolist() == pytest.approx([0.5, 0.0, 0.0, 2.0])
    task.step(torch.zeros(2, 12))
    assert task.thrusts[0].tolist() == pytest.approx([0.5, 0.0, 0.0, 2.0])
    for _ in range(2):
        task.step(actions)
    limit = math.pi / 6.0
    assert task.targets[0, :2].tolist() == pytest.approx([limit, -limit])
    assert task.thrusts[0].tolist() == pytest.approx([1.5, 0.0, 0.0, 2.0])


def test_the_step_that_starts_an_episode_has_no_thrust(make_task: MakeTask) -> None:
    task = make_task("task=Quadcopter", num_envs=2)
    task.reset()
    task.step(torch.ones(2, 12))
    assert (task.thrusts == 2.0).all()  # somebody saw the first state: the action counts
    task.reset_buf[0] = 1
    task.step(torch.ones(2, 12))
    assert task.thrusts.tolist() == [[0.0] * 4, [2.0] * 4]
    assert 0.0 < task.targets[0].abs().max() <= 0.2
    # A body without thrust falls, its hinges stay where they were drawn.
    assert task.simulation.root_states[0, 9].item() == pytest.approx(-9.81 * 0.01, rel=1e-3)
    torch.testing.assert_close(task.simulation.dof_pos[0], task.targets[0], atol=1e-4, rtol=0.0)


def test_bodies_that_turn_fast_are_slowed_down_to_two_turns_a_second(make_task: MakeTask) -> None:
    task = make_task("task=Quadcopter", num_envs=2)
    task.reset()
    root = torch.tensor([[0.3, 0.2, 1.5, *UPRIGHT, 0.5, 0.0, 0.0, 0.0, 0.0, 60.0]]).repeat(2, 1)
    root[1, 12] = 12.0
    task.simulation.write_state(torch.arange(2), root, torch.zeros(2, 8), torch.zeros(2, 8))
    task.targets.zero_()
    task.step(torch.zeros(2, 12))
    state = task.simulation.root_states
    assert state[:, 12].tolist() == pytest.approx([4.0 * math.pi, 12.0], rel=1e-5)
    assert state[0, :2].tolist() == pytest.approx([0.305, 0.2], abs=1e-4)
    assert state[0, 7].item() == pytest.approx(0.5, abs=1e-4)
    assert task.obs_buf[0, 12].item() == pytest.approx(4.0, rel=1e-5)


def test_episodes_end_at_their_length_or_by_a_failure(make_task: MakeTask) -> None:
    task = make_task("task=Quadcopter", num_envs=4)
    task.reset()
    task.progress_buf[:] = torch.tensor([497, 498, 10, 498])
    root = torch.tensor([[0.0, 0.0, 1.0, *UPRIGHT, *[0.0] * 6]]).repeat(4, 1)
    root[2, 2], root[3, 0] = 0.29, 3.1
    task.simulation.write_state(torch.arange(4), root, torch.zeros(4, 8), torch.zeros(4, 8))
    *_, dones, infos = task.step(torch.zeros(4, 12))
    assert dones.tolist() == [0, 1, 1, 1]
    assert infos["time_outs"].tolist() == [False, True, False, False]
