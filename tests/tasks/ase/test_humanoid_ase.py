"""Sizes, times, drives and actions of ASE's humanoids, against the published tables."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.tasks.ase.humanoid_ase import (
    HumanoidHeading,
    HumanoidLocation,
    HumanoidReach,
    HumanoidStrike,
)

# joint, degrees of freedom, kp, armature, effort (Nm), offset and scale of PD targets (rad);
# kd is a tenth of kp.
TRUNK = [("abdomen", 3, 1000, 0.02, 200, 0, 1.88496), ("neck", 3, 100, 0.01, 50, 0, 1.25664)]
RIGHT_HAND = ("right_hand", 3, 100, 0.01, 50, 0, 1.88496)


def _arm(side: str) -> list[tuple]:
    return [
        (f"{side}_shoulder", 3, 400, 0.02, 100, 0, 3.14159),
        (f"{side}_elbow", 1, 300, 0.01, 70, -1.39626, 1.95477),
    ]


def _leg(side: str) -> list[tuple]:
    return [
        (f"{side}_hip", 3, 500, 0.02, 200, 0, 2.93215),
        (f"{side}_knee", 1, 500, 0.02, 150, 1.39626, 1.95477),
        (f"{side}_ankle", 3, 400, 0.01, 90, 0, 1.15192),
    ]


LEGS = [*_leg("right"), *_leg("left")]
DRIVES = {
    False: [*TRUNK, *_arm("right"), *_arm("left"), *LEGS],
    True: [*TRUNK, *_arm("right"), RIGHT_HAND, *_arm("left"), *LEGS],
}
# The table has five decimals.
FIVE_DECIMALS = 5.1e-6
both_bodies = pytest.mark.parametrize("armed", [False, True])


def _per_dof(armed: bool, column: int) -> torch.Tensor:
    values = [[float(row[column])] * row[1] for row in DRIVES[armed]]
    return torch.tensor([value for group in values for value in group])


# --- sizes and times --------------------------------------------------------------------------


def test_sizes_without_a_goal(make_ase) -> None:
    for armed, num_obs, num_actions, num_amp_obs in [(False, 223, 28, 1250), (True, 253, 31, 1400)]:
        task = make_ase(2, armed=armed)
        assert (task.num_obs, task.num_actions) == (num_obs, num_actions)
        assert (task.num_amp_obs, task.amp_observation_space.shape) == (num_amp_obs, (num_amp_obs,))
        assert task.get_task_obs_size() == 0
        assert task.reset()["obs"].shape == (2, num_obs)
        observations, rewards, _, infos = task.step(torch.zeros(2, num_actions))
        assert observations["obs"].shape == (2, num_obs)
        assert infos["amp_obs"].shape == (2, num_amp_obs)
        assert rewards.tolist() == [1.0, 1.0]


def test_sizes_with_a_goal(make_ase) -> None:
    for cls, size, armed_total, total in [
        (HumanoidHeading, 5, 258, 228),
        (HumanoidLocation, 2, 255, 225),
        (HumanoidReach, 3, 256, 226),
        (HumanoidStrike, 15, 268, 238),
    ]:
        for armed, expected in ((True, armed_total), (False, total)):
            task = make_ase(1, cls=cls, armed=armed)
            assert (task.get_task_obs_size(), task.num_obs) == (size, expected)
            assert task.reset()["obs"].shape == (1, expected)
        untold = make_ase(1, cls=cls, enableTaskObs=False)
        assert (untold.get_task_obs_size(), untold.num_obs) == (0, 223)
        assert untold.reset()["obs"].shape == (1, 223)


# --- drives -----------------------------------------------------------------------------------


@both_bodies
def test_gains_and_efforts_are_ase_s(make_ase, armed: bool) -> None:
    model = make_ase(1, armed=armed).simulation.model
    kp, effort = _per_dof(armed, 2).numpy(), _per_dof(armed, 4).numpy()
    assert model.nu == len(kp)
    # The bias of kp is one unit in the last place off; see `set_actuators`.
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], kp, rtol=1e-15)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1], -kp, rtol=1e-15)
    np.testing.assert_allclose(model.actuator_biasprm[:, 2], -kp / 10.0, rtol=1e-15)
    np.testing.assert_allclose(model.actuator_forcerange, np.stack((-effort, effort), 1))
    assert not model.actuator_forcelimited.any()


@both_bodies
def test_armatures_are_ase_s(make_ase, armed: bool) -> None:
    model = make_ase(1, armed=armed).simulation.model
    # Six degrees of freedom of the root come first.
    np.testing.assert_allclose(model.dof_armature[6:], _per_dof(armed, 3).numpy(), rtol=1e-6)
    assert not model.dof_armature[:6].any()
    assert not model.jnt_stiffness.any()
    assert not model.dof_damping.any()


# --- actions ----------------------------------------------------------------------------------


@both_bodies
def test_actions_become_pd_targets_by_ase_s_rule(make_ase, controls_of, armed: bool) -> None:
    task = make_ase(3, armed=armed)
    controls = controls_of(task)
    actions = torch.zeros(3, task.num_actions)
    actions[1], actions[2] = 0.5, -9.0  # the last is clamped to -1
    task.step(actions)
    offset, scale = _per_dof(armed, 5), _per_dof(armed, 6)
    for row, action in enumerate((0.0, 0.5, -1.0)):
        expected = offset + scale * action
        torch.testing.assert_close(controls[0][row], expected, rtol=0.0, atol=2 * FIVE_DECIMALS)


def test_the_shown_observations_are_of_the_clips_states(make_task) -> None:
    """The simulation computes them in parts: more moments than environments."""
    task = make_task("task=HumanoidASE", "task.env.motion_file=walk", num_envs=4)
    torch.manual_seed(0)
    demo = task.fetch_tracking_demo(10)
    torch.manual_seed(0)  # the same moments once more
    lib = task.motion_lib
    motion_ids = lib.sample_motions(10)
    times = lib.sample_time(motion_ids, truncate_time=3 * task.control_dt_s)
    state = lib.get_motion_state(motion_ids, times)
    root = torch.cat((state.root_pos, state.root_rot, state.root_vel, state.root_ang_vel), dim=-1)
    task.reset()
    ids = torch.arange(4)
    task.simulation.write_state(ids, root[6:], state.dof_pos[6:], state.dof_vel[6:])
    torch.testing.assert_close(demo.obs[6:], task.compute_obs())
    assert demo.amp_obs.shape == (10, task.num_amp_obs)
    assert demo.actions.shape == (10, 28)
    assert float(demo.actions.abs().max()) <= 1.0
