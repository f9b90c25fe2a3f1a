"""The goal strike in the simulation: the box, where it stands, and hits that fail the episode."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.tasks.ase.humanoid_ase import HumanoidStrike

# Arms bent by 90 degrees: the right hand (radius 0.04 m) is 0.258947 m in front of the elbow, which
# is 0.02405 m behind the root.
HAND_FRONT_M = 0.258947 - 0.02405 + 0.04


@pytest.fixture
def make(make_ase):
    """Return a maker of HumanoidStrike."""
    return lambda *args, **env: make_ase(*args, cls=HumanoidStrike, **env)


def _place_box(task: HumanoidStrike, state: list[float]) -> None:
    states = torch.tensor([[state]]).expand(task.num_envs, 1, 13).contiguous()
    task.simulation.write_object_states(torch.arange(task.num_envs), torch.tensor([0]), states)


LYING = [3.0, 0.0, 0.2, 0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5), *[0.0] * 6]


def _standing_at(x: float, y: float = 0.0, speed: float = 0.0) -> list[float]:
    return [x, y, 0.9, 0.0, 0.0, 0.0, 1.0, speed, *[0.0] * 5]


# --- the box ----------------------------------------------------------------------------------


def test_the_box_of_the_specification(make) -> None:
    sim = make(1).simulation
    assert sim.object_names == ("target",)
    model = sim.model
    body, joint = model.body("target"), model.joint("target")
    assert float(body.mass[0]) == pytest.approx(8.64)  # 0.4 * 0.4 * 1.8 m^3 of 30 kg/m^3
    geom = model.geom("target")
    assert geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX
    np.testing.assert_allclose(geom.size, [0.2, 0.2, 0.9])
    # It loses a hundredth of its velocities in a second: m, and m (a^2 + b^2) / 12.
    first = int(joint.dofadr[0])
    inertia = [8.64 * (0.4**2 + 1.8**2) / 12.0] * 2 + [8.64 * 2 * 0.4**2 / 12.0]
    np.testing.assert_allclose(
        model.dof_damping[first : first + 6], 0.01 * np.array([8.64] * 3 + inertia)
    )
    # The character's own joints are not damped.
    assert not model.dof_damping[:first].any()


def test_the_box_stands_upright_at_rest_about_the_character(make) -> None:
    torch.manual_seed(0)
    task = make(16, stateInit="Random")
    env_ids = torch.arange(16).flip(0)  # they may be named in any order
    task.reset_done()
    states = []
    for _ in range(25):
        task.goal.reset(env_ids)
        states.append(task.simulation.object_states[:, 0].clone())
    root = task.simulation.root_states[:, :2]
    assert root[:, 0].max() > 1.0  # the characters are not all at the origin
    boxes = torch.stack(states)
    offsets = (boxes[..., :2] - root).flatten(0, 1)
    boxes = boxes.flatten(0, 1)
    distances = offsets.norm(dim=-1)
    # 400 boxes: the ends of the range are reached, float32 of 10 m has 1e-6.
    assert 0.5 - 1e-5 < distances.min() < 0.52
    assert 9.5 < distances.max() < 10.0 + 1e-5
    # Half of them within 1.5 m, and 1 / 9.5 of the others; standard deviation 0.025.
    assert float((distances < 1.5).float().mean()) == pytest.approx(0.5 + 0.5 / 9.5, abs=0.1)
    # On all sides: the mean of the directions has a standard deviation of sqrt(0.5 / 400) = 0.035.
    assert (offsets / distances.unsqueeze(-1)).mean(dim=0).abs().max() < 0.18
    assert (boxes[:, 2] == torch.tensor(0.9)).all()
    assert (boxes[:, 3:5] == 0.0).all()
    # Turned about z by any angle: cosines of the whole turn on both sides.
    turns = 2.0 * torch.atan2(boxes[:, 5], boxes[:, 6])
    assert turns.min() < 0.2
    assert turns.max() > 2.0 * math.pi - 0.2
    assert (boxes[:, 7:] == 0.0).all()


def test_a_reset_puts_the_box_back_on_its_feet(make) -> None:
    torch.manual_seed(0)
    task = make(2)
    task.reset()
    lying = [3.0, 0.0, 0.2, 0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5), 1.0, *[0.0] * 5]
    _place_box(task, lying)
    kept = task.simulation.object_states[1].clone()
    task.reset_idx(torch.tensor([0]))
    states = task.simulation.object_states
    assert states[0, 0, 2] == torch.tensor(0.9)
    assert (states[0, 0, 7:] == 0.0).all()
    assert torch.equal(states[1], kept)


# --- hits -------------------------------------------------------------------------------------


@pytest.fixture
def hit(hold_pose) -> Callable[..., dict[str, Any]]:
    """Return `hit(task, box)`, infos of the second step, in which the box is met."""

    def infos_of(task: HumanoidStrike, box: list[float]) -> Any:
        task.reset()
        _bend_arms(task)
        _place_box(task, _standing_at(5.0))
        infos = task.step(hold_pose(task))[-1]
        assert infos["terminate"].tolist() == [0] * task.num_envs
        _bend_arms(task)
        _place_box(task, box)
        infos = task.step(hold_pose(task))[-1]
        assert task.simulation.object_contact_forces[:, 0, :2].abs().amax() > 1.0
        return infos

    return infos_of


def _bend_arms(task: HumanoidStrike) -> None:
    n, sim = task.num_envs, task.simulation
    root, dof_pos = torch.zeros(n, 13), torch.zeros(n, task.num_actions)
    root[:, 2], root[:, 6] = 0.89, 1.0
    dof_pos[:, [sim.dof_names.index(f"{side}_elbow") for side in ("left", "right")]] = -math.pi / 2
    sim.write_state(torch.arange(n), root, dof_pos, torch.zeros_like(dof_pos))


# To the right of the middle, so that the left arm is not met; it moves towards the character.
BEFORE_THE_HAND = _standing_at(HAND_FRONT_M + 0.2 + 0.005, -0.28, -1.0)
# Beside the left arm, whose shoulder is met first.
BESIDE_THE_SHOULDER = [-0.15, 0.18311 + 0.045 + 0.2 - 0.005, 0.9, 0.0, 0.0, 0.0, 1.0, *[0.0] * 6]
BESIDE_THE_SHOULDER[8] = -1.0


def test_a_hit_with_the_hand_is_allowed(make, hit) -> None:
    task = make(1, stateInit="Default")
    infos = hit(task, BEFORE_THE_HAND)
    assert infos["terminate"].tolist() == [0]
    hand = task.simulation.body_names.index("right_hand")
    assert task.simulation.contact_forces[0, hand].abs().max() > 1.0


def test_a_hit_with_another_body_fails_the_episode(make, hit) -> None:
    task = make(1, stateInit="Default")
    infos = hit(task, BESIDE_THE_SHOULDER)
    assert infos["terminate"].tolist() == [1]
    assert task.reset_buf.tolist() == [1]
    assert infos["time_outs"].tolist() == [False]


def test_a_touch_is_forgiven_in_training_until_enough_boxes_fall(make, hit) -> None:
    task = make(4, stateInit="Default", forgiveTouch=0.4)
    task.is_training = True
    infos = hit(task, BESIDE_THE_SHOULDER)
    assert infos["terminate"].tolist() == [0] * 4
    assert infos["time_outs"].tolist() == [True] * 4
    task.is_training = False
    assert hit(task, BESIDE_THE_SHOULDER)["terminate"].tolist() == [1] * 4
    task.is_training = True
    # One of two episodes in the window; a later lower share does not forgive again.
    for box, fell_share in ((LYING, 0.5), (_standing_at(3.0), 0.25)):
        task.reset_idx(torch.arange(4))
        task.goal.fell_share = 0.0 if box is LYING else 0.5
        _place_box(task, box)
        task.step(torch.zeros(4, task.num_actions))
        task.reset_idx(torch.arange(4))
        assert task.goal.fell_share == pytest.approx(fell_share)
        assert hit(task, BESIDE_THE_SHOULDER)["terminate"].tolist() == [1] * 4
