"""When an episode of ASE's humanoids ends by a fall: heights per body, bodies that may touch."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from isaacgymenvs_lite.tasks.ase.humanoid_ase import HumanoidASE
from isaacgymenvs_lite.tasks.base.vec_task import Done

HALF = math.sqrt(0.5)
HEAD, LEFT_LOWER_ARM, SHIELD = 2, 8, 9  # the arm and the shield of the armed body
# On its back just above the floor, whose contacts end an episode: height and rotation of the root.
ON_ITS_BACK = (0.085, [0.0, -HALF, 0.0, HALF])
# Head down, 2 mm above the floor: the head's origin is 0.460045 m from the root's, its sphere of
# 0.095 m is 0.175 m further.
ON_ITS_HEAD = (0.460045 + 0.175 + 0.095 + 0.002, [0.0, 1.0, 0.0, 0.0])


def _pose(task: HumanoidASE, height: float, rotation: list[float], **dofs: float) -> None:
    """Put all characters there at rest, joints at zero but `dofs`."""
    n, sim = task.num_envs, task.simulation
    root, dof_pos = torch.zeros(n, 13), torch.zeros(n, task.num_actions)
    root[:, 2] = height
    root[:, 3:7] = torch.tensor(rotation)
    for name, angle in dofs.items():
        dof_pos[:, sim.dof_names.index(name)] = angle
    sim.write_state(torch.arange(n), root, dof_pos, torch.zeros_like(dof_pos))


@pytest.fixture
def two_steps(hold_pose) -> Callable[[HumanoidASE], tuple[list[int], list[int]]]:
    """Return `two_steps(task)`: terminate flags of the first and second step in the task's pose."""

    def flags(task: HumanoidASE) -> tuple[list[int], list[int]]:
        actions = hold_pose(task)
        first = task.step(actions)[-1]["terminate"].tolist()
        return first, task.step(actions)[-1]["terminate"].tolist()

    return flags


def test_a_fall_ends_the_episode_but_not_in_its_first_step(make_ase, two_steps) -> None:
    task = make_ase(1, stateInit="Default")
    task.reset()
    _pose(task, *ON_ITS_BACK)
    assert two_steps(task) == ([0], [1])
    assert task.reset_buf.tolist() == [1]
    assert not task.timeout_buf.any()
    task.reset_done()
    assert task.done_buf.tolist() == [Done.RUNNING]


def test_heights_of_the_specification(make_ase) -> None:
    plain, armed = make_ase(1), make_ase(1, armed=True)
    expected = torch.full((15,), 0.15)
    expected[HEAD] = 0.3
    torch.testing.assert_close(plain.termination_heights_m, expected)
    expected = torch.full((17,), 0.15)
    expected[HEAD], expected[LEFT_LOWER_ARM] = 0.3, 0.32
    torch.testing.assert_close(armed.termination_heights_m, expected)
    high = make_ase(1, armed=True, terminationHeight=0.5)
    torch.testing.assert_close(high.termination_heights_m, torch.full((17,), 0.5))


def test_a_head_below_30_cm_is_a_fall(make_ase, two_steps) -> None:
    task = make_ase(1, stateInit="Default")
    task.reset()
    _pose(task, *ON_ITS_HEAD)
    assert two_steps(task) == ([0], [1])
    heights = task.simulation.body_pos[0, :, 2]
    assert 0.15 < heights[HEAD] < 0.3
    # Nothing else is low.
    assert heights.min() > 0.15


def test_the_arm_with_the_shield_below_32_cm_is_a_fall(make_ase, two_steps) -> None:
    # Sitting, legs and lower arms stretched forward; the shield (radius 0.3 m) is 2 mm above the
    # floor. Only it and its arm may not be low.
    def sits_on(contact_bodies: list[str]) -> HumanoidASE:
        task = make_ase(1, armed=True, stateInit="Default", contactBodies=contact_bodies)
        task.reset()
        _pose(task, 0.097, [0.0, 0.0, 0.0, 1.0], **bent)
        return task

    quarter = -0.5 * math.pi
    bent = {"right_hip_y": quarter, "left_hip_y": quarter}
    bent |= {"right_elbow": quarter, "left_elbow": quarter}
    names = make_ase(1, armed=True).simulation.body_names
    may_touch = [name for name in names if name not in ("left_lower_arm", "shield")]
    task = sits_on(may_touch)
    assert two_steps(task) == ([0], [1])
    heights = task.simulation.body_pos[0, :, 2]
    assert 0.15 < heights[LEFT_LOWER_ARM] < 0.32
    assert heights[SHIELD] > 0.15
    # An arm that may touch the floor is as low, and no fall.
    task = sits_on([*may_touch, "left_lower_arm"])
    assert two_steps(task) == ([0], [0])
    assert task.simulation.body_pos[0, LEFT_LOWER_ARM, 2] < 0.32
    assert task.simulation.contact_forces[0, SHIELD].abs().max() > 0.1
