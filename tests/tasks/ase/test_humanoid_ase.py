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


@pytest.mark.parametrize(
    ("armed", "num_obs", "num_actions", "num_amp_obs"),
    [(False, 223, 28, 1250), (True, 253, 31, 1400)],
)
def test_sizes_without_a_goal(make_ase, armed, num_obs, num_actions, num_amp_obs) -> None:
    task = make_ase(2, armed=armed)
    assert (task.num_obs, task.num_actions) == (num_obs, num_actions)
    assert (task.num_amp_obs, task.amp_observation_space.shape) == (num_amp_obs, (num_amp_obs,))
    assert task.get_task_obs_size() == 0
    assert task.reset()["obs"].shape == (2, num_obs)
    observations, rewards, _, infos = task.step(torch.zeros(2, num_actions))
    assert observations["obs"].shape == (2, num_obs)
    assert infos["amp_obs"].shape == (2, num_amp_obs)
    assert rewards.tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("cls", "size", "armed_total", "total"),
    [
        (HumanoidHeading, 5, 258, 228),
        (HumanoidLocation, 2, 255, 225),
        (HumanoidReach, 3, 256, 226),
        (HumanoidStrike, 15, 268, 238),
    ],
)
def test_sizes_with_a_goal(make_ase, cls, size, armed_total, total) -> None:
    for armed, expected in ((True, armed_total), (False, total)):
        task = make_ase(1, cls=cls, armed=armed)
        assert (task.get_task_obs_size(), task.num_obs) == (size, expected)
        assert task.reset()["obs"].shape == (1, expected)
    untold = make_ase(1, cls=cls, enableTaskObs=False)
    assert (untold.get_task_obs_size(), untold.num_obs) == (0, 223)
    assert untold.reset()["obs"].shape == (1, 223)


@both_bodies
def test_times(make_ase, armed: bool) -> None:
    task = make_ase(1, armed=armed)
    # two calls of 1/60 s, of two physics steps each
    assert task.dt == pytest.approx(1.0 / 30.0)
    assert task.simulation.dt == pytest.approx(1.0 / 30.0)
    assert task.simulation.substeps == 4
    assert task.max_episode_length == 300


def test_the_armed_body(make_ase) -> None:
    task = make_ase(1, armed=True)
    assert len(task.simulation.body_names) == 17
    assert task.simulation.body_names[5:11] == (
        *("right_hand", "sword", "left_upper_arm", "left_lower_arm", "shield", "left_hand"),
    )
    assert task.simulation.dof_names[9:14] == (
        *("right_elbow", "right_hand_x", "right_hand_y", "right_hand_z", "left_shoulder_x"),
    )
    assert task.key_body_ids.tolist() == [5, 10, 13, 16, 6, 9]


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


def test_effort_limits_are_ase_s(make_ase) -> None:
    task = make_ase(1, enforceEffortLimits=True)
    assert task.simulation.model.actuator_forcelimited.all()
    torch.testing.assert_close(task.motor_efforts, _per_dof(False, 4))


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


def test_joints_go_to_their_targets(make_ase) -> None:
    # In the air without gravity the drives bring all joints to their targets.
    task = make_ase(
        1, stateInit="Default", enableEarlyTermination=False, sim={"gravity": [0.0, 0.0, 0.0]}
    )
    task.reset()
    targets = torch.full((1, 28), 0.3)
    targets[:, 6] = -0.3  # the right arm away from the body, as the left one
    targets[:, [9, 13]], targets[:, [17, 24]] = -0.6, 0.6  # elbows and knees
    actions = (targets - _per_dof(False, 5)) / _per_dof(False, 6)
    for _ in range(45):  # 1.5 s
        task.step(actions)
    # The time constant kd / kp is 0.1 s; the whole body still sways a little.
    torch.testing.assert_close(task.simulation.dof_pos, targets, rtol=0.0, atol=5e-3)


@pytest.mark.parametrize("power_scale", [1.0, 0.4])
@both_bodies
def test_torque_mode(make_ase, controls_of, armed: bool, power_scale: float) -> None:
    task = make_ase(2, armed=armed, pdControl=False, powerScale=power_scale)
    controls = controls_of(task)
    actions = torch.full((2, task.num_actions), 0.5)
    actions[1] = torch.linspace(-1.0, 1.0, task.num_actions)
    task.step(actions)
    expected = actions * _per_dof(armed, 4) * power_scale
    torch.testing.assert_close(controls[0], expected, rtol=1e-6, atol=1e-5)


def test_torque_mode_turns_joints(make_ase) -> None:
    # A tenth of the neck's 50 Nm about z, in the air without gravity, for one control step:
    # the head (m = 3.88 kg, radius 0.095 m) has 2/5 m r^2 + armature = 0.014 + 0.01 kg m^2.
    task = make_ase(1, stateInit="Default", pdControl=False, sim={"gravity": [0.0, 0.0, 0.0]})
    task.reset()
    actions = torch.zeros(1, 28)
    actions[0, 5] = 0.1
    task.step(actions)
    speed = float(task.simulation.dof_vel[0, 5])
    assert speed == pytest.approx(5.0 / 0.024 / 30.0, rel=0.15)  # the rest recoils


def test_the_drives_of_humanoid_amp_stay_isaacgymenvs(make_humanoid, make_ase) -> None:
    make_ase(1)
    amp = make_humanoid(1).simulation.model
    assert amp.actuator("abdomen_x").gainprm[0] == 600.0
    assert amp.joint("abdomen").armature[0] == pytest.approx(0.025)


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


def test_goals_have_no_shown_actions(make_task) -> None:
    """A clip does not show the goal that it serves."""
    assert make_task("task=HumanoidHeading", num_envs=4).fetch_tracking_demo(3) is None
