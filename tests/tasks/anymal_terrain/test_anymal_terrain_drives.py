"""AnymalTerrain's drives and time, and what it tells."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.tasks.anymal_terrain_terms import TERM_NAMES, noise_widths
from tests.tasks.anymal_terrain.conftest import DEFAULT_ANGLES, EXACT

# --- drives and time ------------------------------------------------------------------------


def test_torques_are_those_of_the_pd_formula(make) -> None:
    task = make("task.env.control.decimation=1", *EXACT, num_envs=16)
    task.reset()
    sim = task.simulation
    largest = 0.0
    for scale in (0.5, 0.5, 1.0, 3.0, 6.0):
        for _ in range(20):
            pos, vel = sim.dof_pos.clone(), sim.dof_vel.clone()
            actions = scale * torch.randn(16, 12)
            task.step(actions)
            running = task.progress_buf > 0
            target = 0.5 * actions + torch.tensor(DEFAULT_ANGLES)
            torques = (80.0 * (target - pos) - 2.0 * vel).clamp(-80.0, 80.0)
            # float32 positions of a rad, times 80.
            assert torch.allclose(sim.dof_forces[running], torques[running], atol=2e-4)
            largest = max(largest, torques.abs().max().item())
    assert largest == 80.0


def test_a_control_step_is_four_torques_at_5_ms_each(make) -> None:
    """The drives do what a controller does that computes the torque before each call."""
    task = make(*EXACT, num_envs=1)
    task.reset()
    sim = task.simulation
    model = mujoco.MjModel.from_xml_path(str(assets_dir() / task.default_asset))
    model.actuator_gainprm[:] = 0.0
    model.actuator_biasprm[:] = 0.0
    data = mujoco.MjData(model)
    # In the air, where the ground does not matter.
    data.qpos[2] = 5.0
    data.qpos[7:] = sim.dof_pos[0].double().numpy()
    data.qvel[6:] = sim.dof_vel[0].double().numpy()
    action = np.linspace(-1.0, 3.0, 12)
    clipped = False
    for _ in range(4):
        target = 0.5 * action + np.array(DEFAULT_ANGLES)
        torque = 80.0 * (target - data.qpos[7:]) - 2.0 * data.qvel[6:]
        data.qfrc_applied[6:] = torque.clip(-80.0, 80.0)
        clipped |= bool((np.abs(torque) > 80.0).any())
        mujoco.mj_step(model, data)
    task.step(torch.from_numpy(action).float()[None])
    # The action went there in float32.
    assert sim.dof_pos[0].tolist() == pytest.approx(data.qpos[7:].tolist(), abs=1e-6)
    assert sim.dof_vel[0].tolist() == pytest.approx(data.qvel[6:].tolist(), abs=1e-4)
    assert sim.dof_vel[0].abs().max() > 2.0
    assert clipped


# --- what is told ---------------------------------------------------------------------------


def test_infos_tell_what_ended_episodes_were_paid(make) -> None:
    task = make(*EXACT)
    task.reset()
    paid = torch.zeros(len(TERM_NAMES), 4)
    for step in range(10):
        if step == 9:
            task.progress_buf[1:3] = 998
        *_, infos = task.step(0.3 * torch.randn(4, 12))
        paid += torch.stack([task.reward_terms[name] for name in TERM_NAMES])
        assert ("episode" in infos) == (step == 9)
    told = infos["episode"]
    assert set(told) == {f"rew_{name}" for name in TERM_NAMES} | {"terrain_level"}
    for name, row in zip(TERM_NAMES, paid, strict=True):
        assert told[f"rew_{name}"].item() == pytest.approx(row[1:3].mean().item() / 20.0, rel=1e-4)
    # Other steps tell nothing, and the next episode begins at zero.
    *_, infos = task.step(task.zero_actions())
    assert set(infos) == {"time_outs", "diverged"}
    first = task.reward_terms["lin_vel_xy"][1].item()
    task.progress_buf[1] = 998
    *_, infos = task.step(task.zero_actions())
    both = first + task.reward_terms["lin_vel_xy"][1].item()
    assert infos["episode"]["rew_lin_vel_xy"].item() == pytest.approx(both / 20.0, rel=1e-4)


def test_noise_is_for_the_policy_and_not_for_the_critic(make) -> None:
    task = make("task.env.asymmetric_observations=True", num_envs=256)
    observations = task.reset()
    for _ in range(2):
        noise = observations["obs"] - observations["states"]
        half_widths = noise_widths(task.env_cfg.learn)
        assert (noise.abs() <= half_widths + 1e-5).all()
        assert (noise.abs().max(dim=0).values >= 0.9 * half_widths).all()
        assert noise.mean(dim=0).abs().max() < 0.1
        assert torch.equal(observations["states"], task.compute_obs())
        observations, *_ = task.step(task.zero_actions())
