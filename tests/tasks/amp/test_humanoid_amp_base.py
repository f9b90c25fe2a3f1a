"""The simulated humanoid: actions, observations, ends of episodes."""

from __future__ import annotations

import math

import mujoco
import pytest
import torch

from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import HumanoidAMPBase
from isaacgymenvs_lite.tasks.base.humanoid_observations import compute_humanoid_observations
from isaacgymenvs_lite.tasks.base.vec_task import Done

ELBOWS, KNEES = [9, 13], [17, 24]
EFFORTS = [125] * 3 + [20] * 3 + ([70] * 3 + [60]) * 2 + ([125] * 3 + [100] + [50] * 3) * 2
# float32 of numbers of order 1
ATOL = 1e-6
# A state on its back just above the floor, whose contacts end an episode (root, all else zero).
ON_ITS_BACK = [0.0, 0.0, 0.085, 0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5), *[0.0] * 6]


@pytest.fixture
def make(make_humanoid):
    """Return a maker of the base task: without a motion library."""
    return lambda *args, **env: make_humanoid(*args, cls=HumanoidAMPBase, **env)


def _lay_down(task: HumanoidAMPBase, env_ids: list[int]) -> None:
    n = len(env_ids)
    root, zeros = torch.tensor([ON_ITS_BACK] * n), torch.zeros(n, 28)
    task.simulation.write_state(torch.tensor(env_ids), root, zeros, zeros)


# --- making -----------------------------------------------------------------------------------


def test_sizes_and_times(make) -> None:
    task = make(3)
    assert (task.num_envs, task.num_obs, task.num_actions) == (3, 105, 28)
    assert task.max_episode_length == 300
    assert task.control_freq_inv == 2
    # two calls of 0.0166 s, of two physics steps each
    assert task.dt == pytest.approx(0.0332)
    assert task.simulation.substeps == 4
    assert task.simulation.dt == pytest.approx(0.0332)
    assert task.simulation.num_envs == 3
    assert isinstance(task.simulation.model, mujoco.MjModel)
    assert task.simulation.device == task.device == torch.device("cpu")
    assert (task.cfg["env"]["numObservations"], task.cfg["env"]["numActions"]) == (105, 28)


# --- actions ----------------------------------------------------------------------------------


def test_actions_become_pd_targets(make, controls_of) -> None:
    task = make(3)
    controls = controls_of(task)
    actions = torch.zeros(3, 28)
    actions[1], actions[2] = 0.5, -9.0  # the last is clamped to -1
    task.step(actions)
    # offset + scale * action: 0 and pi of ball joints, -+1.39626 and 1.95477 of hinges
    for row, action in enumerate((0.0, 0.5, -1.0)):
        expected = torch.full((28,), math.pi * action)
        expected[ELBOWS] = -1.396263 + 1.954769 * action
        expected[KNEES] = 1.396263 + 1.954769 * action
        torch.testing.assert_close(controls[0][row], expected, rtol=0.0, atol=2e-6)


def test_joints_go_to_their_targets(make) -> None:
    # In the air without gravity the drives bring all joints to their targets.
    task = make(1, sim={"gravity": [0.0, 0.0, 0.0]}, enableEarlyTermination=False)
    task.reset()
    targets = torch.full((1, 28), 0.3)
    targets[:, 6] = -0.3  # the right arm away from the body, as the left one
    targets[:, ELBOWS], targets[:, KNEES] = -0.6, 0.6
    scale = torch.full((28,), math.pi)
    offset = torch.zeros(28)
    scale[ELBOWS + KNEES] = 1.954769
    offset[ELBOWS], offset[KNEES] = -1.396263, 1.396263
    for _ in range(60):  # 2 s
        task.step((targets - offset) / scale)
    # The time constant kd / kp is 0.1 s; the whole body still sways a little.
    torch.testing.assert_close(task.simulation.dof_pos, targets, rtol=0.0, atol=5e-3)


def test_torque_mode(make, controls_of) -> None:
    for power_scale in [1.0, 0.4]:
        task = make(2, pdControl=False, powerScale=power_scale)
        controls = controls_of(task)
        actions = torch.full((2, 28), 0.5)
        actions[1] = torch.linspace(-1.0, 1.0, 28)
        task.step(actions)
        expected = actions * torch.tensor(EFFORTS) * power_scale
        torch.testing.assert_close(controls[0], expected, rtol=1e-6, atol=1e-5)


# --- observations -----------------------------------------------------------------------------


def test_observation_of_the_default_pose(make) -> None:
    task = make(2, stateInit="Default")
    observed = task.reset()["obs"]
    ball = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    arm, leg = [*ball, 0.0], [*ball, 0.0, *ball]
    # Hands: offsets of torso, upper arm, lower arm and hand added up.
    hand_z = 0.236151 + 0.24350 - 0.274788 - 0.258947
    expected = [
        *(0.89, *ball, *[0.0] * 6),
        *(*ball, *ball, *arm, *arm, *leg, *leg),
        *[0.0] * 28,
        *(-0.02405, -0.18311, hand_z, -0.02405, 0.18311, hand_z),
        *(0.0, -0.084887, -0.831416, 0.0, 0.084887, -0.831416),
    ]
    torch.testing.assert_close(observed, torch.tensor([expected] * 2), rtol=0.0, atol=ATOL)


def test_observation_after_steps_is_that_of_the_state(make) -> None:
    for local_root_obs in [False, True]:
        task = make(3, localRootObs=local_root_obs)
        task.reset()
        torch.manual_seed(0)
        for _ in range(5):
            observations, *_ = task.step(0.3 * torch.randn(3, 28))
        sim = task.simulation
        expected = compute_humanoid_observations(
            sim.root_states,
            sim.dof_pos,
            sim.dof_vel,
            # right hand, left hand, right foot, left foot
            sim.body_pos[:, [5, 8, 11, 14]],
            local_root_obs,
        )
        torch.testing.assert_close(observations["obs"], expected, rtol=0.0, atol=ATOL)


# --- ends of episodes -------------------------------------------------------------------------


def test_a_fall_ends_the_episode_but_not_in_its_first_step(make) -> None:
    task = make(3)
    task.reset()
    _lay_down(task, [1])
    *_, dones, infos = task.step(torch.zeros(3, 28))
    assert task.simulation.contact_forces[1].abs().max() > 1.0
    assert dones.tolist() == infos["terminate"].tolist() == [0, 0, 0]
    *_, dones, infos = task.step(torch.zeros(3, 28))
    assert dones.tolist() == infos["terminate"].tolist() == [0, 1, 0]
    assert infos["time_outs"].tolist() == [False] * 3
    # The observation is the terminal one; the reset comes when it is asked for.
    assert float(task.obs_buf[1, 0]) < 0.2
    task.reset_done()
    assert float(task.obs_buf[1, 0]) == pytest.approx(0.89)
    assert task.done_buf.tolist() == [Done.RUNNING] * 3


def test_a_diverged_simulation_cuts_its_episode_off(make, caplog: pytest.LogCaptureFixture) -> None:
    task = make(3, enableEarlyTermination=False)
    task.reset()
    zeros = torch.zeros(1, 28)
    root = torch.tensor([[0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 1.0, *[0.0] * 6]])
    task.simulation.write_state(torch.tensor([2]), root, zeros, zeros * float("nan"))
    observations, _, dones, infos = task.step(torch.zeros(3, 28))
    assert dones.tolist() == [0, 0, 1]
    assert infos["terminate"].tolist() == [0, 0, 0]
    assert infos["diverged"].tolist() == infos["time_outs"].tolist() == [False, False, True]
    assert infos["diverged_simulations"] == 1
    assert observations["obs"].isfinite().all()
    assert any("1 simulation(s) diverged" in message for message in caplog.messages)
    task.reset_done()
    *_, dones, _ = task.step(torch.zeros(3, 28))
    assert dones.tolist() == [0, 0, 0]
