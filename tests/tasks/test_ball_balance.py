"""BallBalance: formulas by hand, its closed legs, its sensors, its ends."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.tasks.ball_balance import (
    BallBalance,
    compute_bbot_failures,
    compute_bbot_observations,
    compute_bbot_reward,
    draw_ball_states,
)
from isaacgymenvs_lite.tasks.base.reward_terms import total
from isaacgymenvs_lite.utils.rotations import quat_apply

MakeTask = Callable[..., BallBalance]
# Where the feet are pinned to the ground.
PINS_M = [
    [0.4 * math.cos(angle), 0.4 * math.sin(angle), 0.02]
    for angle in (0.0, 2.0 / 3.0 * math.pi, 4.0 / 3.0 * math.pi)
]
GRAVITY_M_S2 = 9.81
BALL_KG = 200.0 * 4.0 / 3.0 * math.pi * 0.1**3


def _reward(pos: list[float], vel: list[float]) -> float:
    return total(compute_bbot_reward(torch.tensor([pos]), torch.tensor([vel]))).item()


def test_reward_of_the_specification() -> None:
    # float32 sums of numbers up to 1
    assert _reward([0.1, -0.2, 0.8], [0.3, 0.0, -0.4]) == pytest.approx(0.535497, abs=1e-6)


def test_rewards_by_hand() -> None:
    assert _reward([0.0, 0.0, 0.7], [0.0, 0.0, 0.0]) == pytest.approx(1.0)
    assert _reward([0.0, 3.0, 0.7], [0.0, 0.0, 0.0]) == pytest.approx(1.0 / 4.0)
    assert _reward([0.0, 0.0, 1.7], [0.0, -4.0, 3.0]) == pytest.approx(1.0 / 2.0 / 6.0)


def test_order_and_scales_of_the_observation() -> None:
    row = torch.arange(12.0).reshape(1, 12)
    force_x = torch.tensor([[12.0], [13.0], [14.0]])
    torques = torch.arange(15.0, 24.0).reshape(3, 3, 1)  # x, y, z of the three sensors each
    observed = compute_bbot_observations(
        row[:, :3], row[:, 3:6], row[:, 6:9], row[:, 9:], force_x, torques
    )
    expected = [*range(12), *(value / 20.0 for value in range(12, 24))]
    assert observed[0].tolist() == pytest.approx(expected)


def test_a_ball_below_15_cm_is_lost() -> None:
    assert compute_bbot_failures(torch.tensor([0.149, 0.151])).tolist() == [True, False]


def test_balls_start_above_the_tray_and_move_towards_its_middle() -> None:
    torch.manual_seed(0)
    pos, rot, vel, spin = draw_ball_states(torch.arange(20000)).split((3, 4, 3, 3), dim=1)
    distance = pos[:, :2].norm(dim=-1)
    # 20000 draws leave gaps of about 1/20000 of a range at its ends.
    for values, low, high in ((distance, 0.001, 0.5), (pos[:, 2], 1.0, 2.0)):
        assert low <= values.min() < low + 0.001 * (high - low)
        assert high - 0.001 * (high - low) < values.max() <= high
        # The mean of 20000 uniform numbers: standard error 0.2 % of their range
        assert values.mean().item() == pytest.approx((low + high) / 2, abs=0.01 * (high - low))
    assert pos[:, :2].mean(0).abs().max() < 0.01
    speed = vel[:, :2].norm(dim=-1)
    inwards = -(vel[:, :2] * pos[:, :2]).sum(-1)
    torch.testing.assert_close(inwards, speed * distance)
    share = speed / (5.0 * (distance - 0.001) / 0.499)
    assert share[distance > 0.01].max() <= 1.0 + 1e-5
    assert share[distance > 0.01].mean().item() == pytest.approx(0.5, abs=0.01)
    assert (vel[:, 2] == -5.0).all()
    assert (spin == 0.0).all()
    assert (rot == torch.tensor([0.0, 0.0, 0.0, 1.0])).all()


def test_the_model_is_that_of_the_tables(make_task: MakeTask) -> None:
    model = make_task("task=BallBalance").simulation.model
    masses = {"tray": 1.5708, "ball": 0.8378}
    for leg in range(3):
        masses |= {f"upper_leg{leg}": 0.4859, f"lower_leg{leg}": 0.4859}
        assert np.degrees(model.joint(f"upper_leg_joint{leg}").range) == pytest.approx([-45, 45])
        assert np.degrees(model.joint(f"lower_leg_joint{leg}").range) == pytest.approx([-70, 90])
        assert model.joint(f"upper_leg_joint{leg}").armature[0] == 0.0
    assert {name: model.body(name).mass[0] for name in masses} == pytest.approx(masses, abs=1e-4)
    quats = {
        "upper_leg0": (0.382683, 0.0, -0.92388, 0.0),
        "upper_leg1": (0.191342, 0.800103, -0.46194, 0.331414),
        "upper_leg2": (-0.191342, 0.800103, 0.46194, 0.331414),
        "lower_leg1": (0.707107, 0.0, -0.707107, 0.0),
    }
    for name, quat in quats.items():
        assert model.body(name).quat == pytest.approx(quat, abs=1e-6)
    assert model.body("upper_leg1").pos == pytest.approx((-0.13636, 0.236183, -0.157279), abs=1e-6)
    assert model.opt.timestep == pytest.approx(0.01)


def _feet(task: BallBalance) -> torch.Tensor:
    """Return where the feet are (N, 3, 3), in m."""
    sim = task.simulation
    legs = [sim.body_names.index(f"lower_leg{leg}") for leg in range(3)]
    along = torch.tensor([0.0, 0.0, 0.18]).expand(task.num_envs, 3, 3)
    return sim.body_pos[:, legs] + quat_apply(sim.body_rot[:, legs], along)


def _without_ball(task: BallBalance) -> None:
    """Start new episodes with the balls on the ground, far away, and never end them."""
    task.reset()
    states = torch.zeros(task.num_envs, 1, 13)
    states[..., 0], states[..., 2], states[..., 6] = 3.0, 0.1, 1.0
    task.simulation.write_object_states(torch.arange(task.num_envs), torch.tensor([0]), states)


def _step(task: BallBalance, actions: torch.Tensor) -> dict[str, torch.Tensor]:
    task.reset_buf.zero_()
    return task.step(actions)[0]


def test_the_legs_close_the_chain_at_the_pins(make_task: MakeTask) -> None:
    task = make_task("task=BallBalance")
    task.reset()
    # float32 positions of bodies some decimetres away
    torch.testing.assert_close(_feet(task)[0], torch.tensor(PINS_M), atol=1e-6, rtol=0.0)
    model = task.simulation.model
    assert model.eq_data[:, 3:6] == pytest.approx(np.array(PINS_M), abs=1e-6)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert (data.nefc, data.ncon) == (9, 0)  # of the pins only: the feet do not touch the floor
    assert np.abs(data.efc_pos).max() < 1e-12


def test_the_tray_follows_the_targets(make_task: MakeTask) -> None:
    task = make_task("task=BallBalance", num_envs=2)
    _without_ball(task)
    actions = torch.tensor([[0.5, 0.5, 0.5], [0.4, -0.2, 0.1]])
    for _ in range(4):
        _step(task, actions)
    for _ in range(60):
        _step(task, torch.zeros(2, 3))
    knees = task.simulation.dof_pos[:, 1::2]
    torch.testing.assert_close(task.targets, 4 * 0.2 * actions)
    # Weight against the drives' stiffness
    torch.testing.assert_close(knees, task.targets, atol=2e-3, rtol=0.0)
    # Knees of 90 and 0.4 rad more, and hips of half of that less, so that the tray is level.
    assert task.simulation.dof_pos[0, ::2].tolist() == pytest.approx([-0.2] * 3, abs=1e-3)
    height = 0.02 + 2.0 * 0.36 * math.sin(math.pi / 4 + 0.2) + 0.03
    assert task.simulation.root_states[0, 2].item() == pytest.approx(height, abs=1e-3)
    feet = torch.tensor(PINS_M).expand(2, 3, 3)
    torch.testing.assert_close(_feet(task), feet, atol=1e-4, rtol=0.0)


def test_falling_balls_do_not_break_through(make_task: MakeTask) -> None:
    torch.manual_seed(0)
    task = make_task("task=BallBalance", num_envs=256)
    task.reset()
    lowest = torch.full((256,), math.inf)
    for _ in range(60):
        _step(task, task.zero_actions())
        ball = task.simulation.object_states[:, 0]
        above = ball[:, :2].norm(dim=-1) < 0.4
        lowest = torch.where(above, torch.minimum(lowest, ball[:, 2]), lowest)
    # At up to 6.7 m/s a ball is 6.7 cm deep, a step after it came; its radius is 10 cm.
    assert lowest.min() > 0.57
    assert (lowest < 0.70).sum() > 200
    assert task.simulation.num_failures == 0


def test_actions_move_the_targets_within_the_limits(make_task: MakeTask) -> None:
    task = make_task("task=BallBalance", num_envs=2)
    _without_ball(task)
    _step(task, torch.tensor([[1.0, -1.0, 0.25], [7.0, -7.0, 0.0]]))
    assert task.targets[0].tolist() == pytest.approx([0.2, -0.2, 0.05])
    assert task.targets[1].tolist() == pytest.approx([0.2, -0.2, 0.0])
    _step(task, torch.zeros(2, 3))
    assert task.targets[0].tolist() == pytest.approx([0.2, -0.2, 0.05])
    for _ in range(9):
        _step(task, torch.tensor([[1.0, -1.0, 0.0]]).repeat(2, 1))
    limits = [math.radians(90.0), math.radians(-70.0)]
    assert task.targets[:, :2].tolist() == [pytest.approx(limits)] * 2


def test_the_action_of_the_step_that_starts_an_episode_does_nothing(make_task: MakeTask) -> None:
    task = make_task("task=BallBalance", num_envs=2)
    task.reset()
    task.step(torch.ones(2, 3))
    assert (task.targets == 0.2).all()  # somebody saw the first state: the action counts
    task.reset_buf[0] = 1
    task.step(torch.ones(2, 3))
    assert task.targets.tolist() == [[0.0] * 3, [pytest.approx(0.4)] * 3]
    assert task.progress_buf.tolist() == [1, 2]


def _after_a_ball_is_put(task: BallBalance, x: float, y: float, speed: float, steps: int) -> list:
    """Return what the three sensors tell of a ball on the tray: force x, torques x, y, z."""
    task.reset()
    state = torch.tensor([x, y, 0.559117 + 0.01 + 0.1, 0.0, 0.0, 0.0, 1.0, speed, *[0.0] * 5])
    task.simulation.write_object_states(
        torch.tensor([0]), torch.tensor([0]), state.reshape(1, 1, 13)
    )
    for _ in range(steps):
        observed = _step(task, task.zero_actions())["obs"][0]
    return observed[12:].reshape(4, 3).tolist()


def test_sensors_feel_a_resting_ball(make_task: MakeTask) -> None:
    x, y = 0.2, 0.1
    task = make_task("task=BallBalance", num_envs=1)
    forces_x, torques_x, torques_y, torques_z = _after_a_ball_is_put(task, x, y, 0.0, 40)
    weight = BALL_KG * GRAVITY_M_S2 / 20.0
    # The ball rolls by a millimetre on a tray that gives way by as much.
    assert forces_x == pytest.approx([0.0] * 3, abs=2e-3)
    assert torques_x == pytest.approx([-(y - pin[1]) * weight for pin in PINS_M], abs=3e-3)
    assert torques_y == pytest.approx([(x - pin[0]) * weight for pin in PINS_M], abs=3e-3)
    assert torques_z == pytest.approx([0.0] * 3, abs=2e-3)


def test_sensors_feel_the_friction_of_a_sliding_ball(make_task: MakeTask) -> None:
    task = make_task("task=BallBalance", num_envs=1)
    forces_x, torques_x, _, torques_z = _after_a_ball_is_put(task, -0.2, 0.0, 2.0, 2)
    # With a coefficient of friction of 1 it pulls along x as much as it presses down.
    pull = forces_x[0]
    assert pull > 0.4
    assert forces_x == pytest.approx([pull] * 3)
    assert torques_x == pytest.approx([pin[1] * pull for pin in PINS_M], rel=1e-3)
    assert torques_z == pytest.approx([pin[1] * pull for pin in PINS_M], rel=1e-3)


def test_episodes_end_at_their_length_or_with_a_lost_ball(make_task: MakeTask) -> None:
    task = make_task("task=BallBalance", num_envs=3)
    task.reset()
    task.progress_buf[:] = torch.tensor([497, 498, 10])
    states = torch.zeros(1, 1, 13)
    states[..., 0], states[..., 2], states[..., 6] = 2.0, 0.12, 1.0
    task.simulation.write_object_states(torch.tensor([2]), torch.tensor([0]), states)
    *_, dones, infos = task.step(task.zero_actions())
    assert dones.tolist() == [0, 1, 1]
    assert infos["time_outs"].tolist() == [False, True, False]
    task.step(task.zero_actions())
    assert task.progress_buf.tolist() == [499, 1, 1]
    # Both fall again from where episodes start.
    assert (task.simulation.object_states[1:, 0, 2] > 0.9).all()
