"""Anymal: formulas by hand, starts and ends of episodes, its drives."""

from __future__ import annotations

import math

import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks.anymal import (
    compute_anymal_observations,
    compute_anymal_reward,
    rotate_down,
)
from isaacgymenvs_lite.tasks.base.velocity_tracking import (
    BaseMotion,
    LearnConfig,
    compute_base_motion,
)

# The specification's rotation: (0.1, -0.2, 0.3, 0.9), normalised.
TURNED = torch.nn.functional.normalize(torch.tensor([[0.1, -0.2, 0.3, 0.9]]))
DEFAULT_ANGLES = [0.03, 0.4, -0.8, 0.03, -0.4, 0.8, -0.03, 0.4, -0.8, -0.03, -0.4, 0.8]


def _columns(*rows: float) -> torch.Tensor:
    """Return quantities (len, 1) of one environment."""
    return torch.tensor(rows)[:, None]


def _specified_motion() -> BaseMotion:
    velocities = torch.tensor([[1.0, 0.2, 0.1, 0.1, -0.2, 0.3]])
    return compute_base_motion(torch.cat((torch.zeros(1, 3), TURNED, velocities), dim=1))


def _values(tensor: torch.Tensor) -> list[float]:
    return tensor.flatten().tolist()


def test_motion_of_the_specification() -> None:
    motion = _specified_motion()
    # The table gives the linear velocity; the axis of the rotation is that of the angular one.
    assert _values(motion.lin_vel) == pytest.approx([0.875789, -0.446316, -0.289474], abs=1e-5)
    assert _values(motion.ang_vel) == pytest.approx([0.1, -0.2, 0.3], abs=1e-5)
    assert _values(motion.gravity) == pytest.approx([-0.442105, -0.063158, -0.894737], abs=1e-5)


def test_gravity_as_published_is_rotated_the_other_way() -> None:
    assert _values(rotate_down(TURNED)) == pytest.approx([0.315789, 0.315789, -0.894737], abs=1e-5)


def test_reward_of_the_specification() -> None:
    commands = _columns(0.5, -0.3, 0.2)
    torques = torch.full((12, 1), 5.0)
    terms = compute_anymal_reward(_specified_motion(), commands, torques, LearnConfig(), 0.02)
    assert sum(terms.values()).item() == pytest.approx(0.019894, abs=1e-6)
    # 12 * 25 * -2.5e-5 * 0.02, and the errors (0.376, 0.146) and 0.1.
    assert terms["torques"].item() == pytest.approx(-1.5e-4)
    assert terms["ang_vel_z"].item() == pytest.approx(0.01 * math.exp(-0.01 / 0.25), rel=1e-4)
    assert terms["lin_vel_xy"].item() == pytest.approx(
        0.02 * math.exp(-(0.375789**2 + 0.146316**2) / 0.25), rel=1e-4
    )
    assert terms["clamp"].item() == 0.0


def test_order_and_scales_of_the_observation() -> None:
    motion = BaseMotion(_columns(1, 2, 3), _columns(4, 5, 6), _columns(7, 8, 9))
    dofs = torch.arange(12.0)[:, None]
    rows = compute_anymal_observations(
        motion, _columns(10, 11, 12), dofs, 100.0 + dofs, 200.0 + dofs, LearnConfig()
    )
    assert rows.shape == (1, 48)
    assert rows[0].tolist() == pytest.approx(
        [2, 4, 6, 1, 1.25, 1.5, 7, 8, 9, 20, 22, 3]
        + list(range(12))
        + [0.05 * (100 + i) for i in range(12)]
        + [200 + i for i in range(12)]
    )


def test_the_key_tells_which_gravity_is_observed(make_task) -> None:
    for key, gravity_x in [("True", -0.5), ("False", 0.5)]:
        task = make_task("task=Anymal", f"task.env.projectedGravityAsPublished={key}")
        task.reset()
        root = task.simulation.root_states.clone()
        # Nose down by 30 degrees about y: in the base's frame gravity leans forward, to +x.
        root[:, 3:7] = torch.tensor([0.0, math.sin(math.pi / 12), 0.0, math.cos(math.pi / 12)])
        sim = task.simulation
        sim.write_state(torch.arange(4), root, sim.dof_pos.clone(), sim.dof_vel.clone())
        task.update_state()
        assert task.compute_obs()[:, 6].tolist() == pytest.approx([gravity_x] * 4, abs=1e-5)


def test_episodes_start_at_scaled_default_angles_with_commands(make_task) -> None:
    task = make_task("task=Anymal", num_envs=512)
    observed = task.reset()["obs"]
    sim = task.simulation
    assert sim.root_states[0].tolist() == pytest.approx([0, 0, 0.62, 0, 0, 0, 1] + [0.0] * 6)
    factors = sim.dof_pos / torch.tensor(DEFAULT_ANGLES)
    assert 0.5 <= factors.min() < 0.51
    assert 1.49 < factors.max() <= 1.5
    # Each joint has its own factor.
    assert (factors.max(dim=1).values - factors.min(dim=1).values).min() > 0.1
    assert 0.099 < sim.dof_vel.abs().max() <= 0.1
    for place, limit in enumerate((2.0, 1.0, 1.0)):
        drawn = task.commands[:, place]
        assert -limit <= drawn.min() < -0.95 * limit
        assert 0.95 * limit < drawn.max() <= limit
    assert torch.allclose(observed[:, 9:12], task.commands * torch.tensor([2.0, 2.0, 0.25]))


def test_a_robot_stands_on_its_feet_when_it_does_nothing(make_task) -> None:
    torch.manual_seed(0)
    task = make_task("task=Anymal", "task.env.learn.episodeLength_s=500")
    task.reset()
    for _ in range(200):
        *_, dones, _ = task.step(task.zero_actions())
        assert not dones.any()
    sim = task.simulation
    # The weight bends the knees by some cm from the 0.543 m of the default angles.
    assert 0.46 < sim.root_states[:, 2].min() <= sim.root_states[:, 2].max() < 0.543
    on_feet = sim.contact_forces[:, 3::3, 2].sum(1)
    assert on_feet.tolist() == pytest.approx([66.751 * 9.81] * 4, rel=0.02)


def test_drives_are_those_of_the_configuration(make_task) -> None:
    task = make_task("task=Anymal", "task.env.control.stiffness=100", "task.env.control.damping=3")
    task.reset()
    n = task.num_envs
    pos, vel = torch.tensor(DEFAULT_ANGLES).repeat(n, 1), torch.zeros(n, 12)
    root = task.simulation.root_states.clone()
    root[:, 2] = 5.0
    vel[1] = 0.5
    task.simulation.write_state(torch.arange(n), root, pos, vel)
    task.simulation.substeps = 1
    actions = torch.zeros(n, 12)
    actions[2:], actions[3] = 0.2, -1.0
    task.simulation.set_controls(task.compute_controls(actions))
    task.simulation.step()
    # Targets are 0.5 rad from the default angles by a full action; implicit in the velocity alone.
    expected = torch.tensor([0.0, -3 * 0.5, 100 * 0.5 * 0.2, -100 * 0.5])[:, None]
    assert torch.allclose(task.simulation.dof_forces, expected.expand(n, 12), atol=1e-4)
    # Away from any contact the torques never exceed 80 Nm.
    task.simulation.set_controls(task.compute_controls(torch.full((n, 12), 9.0)))
    task.simulation.step()
    assert task.simulation.dof_forces.abs().max() == pytest.approx(80.0)


def test_a_fall_ends_one_episode_not_two(make_task) -> None:
    for place in ["base", "knee"]:
        task = make_task("task=Anymal")
        task.reset()
        for _ in range(30):
            *_, dones, infos = task.step(task.zero_actions())
        assert not dones.any()
        root = task.simulation.root_states.clone()
        pos = torch.tensor(DEFAULT_ANGLES).repeat(4, 1)
        if place == "base":  # upside down on its back
            root[:, :7] = torch.tensor([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
        else:  # kneeling
            root[:, 2] = 0.35
            pos = torch.tensor([[0.0, 0.6, -2.4, 0.0, -0.6, 2.4] * 2]).repeat(4, 1)
        root[:, 7:] = 0.0
        task.simulation.write_state(torch.arange(4), root, pos, torch.zeros(4, 12))
        hold = (pos - task.default_dof_pos) / 0.5
        task.clip_actions = 10.0
        for _ in range(20):
            *_, dones, infos = task.step(hold)
            if dones.any():
                break
        assert dones.all()
        assert not infos["time_outs"].any()
        touched = task.simulation.contact_forces.norm(dim=-1)
        assert (touched[:, 0] > 1.0).all() == (place == "base")
        assert (touched[:, 2::3] > 1.0).any(dim=1).all() == (place == "knee")
        # The published task reads the forces of the fall again here.
        *_, dones, infos = task.step(task.zero_actions())
        assert not dones.any()
        assert (task.progress_buf == 0).all()
        assert task.simulation.root_states[:, 2].tolist() == pytest.approx([0.62] * 4)


def test_commands_stay_for_an_episode_and_change_with_it(make_task) -> None:
    task = make_task("task=Anymal")
    task.reset()
    before = task.commands.clone()
    task.step(task.zero_actions())
    assert torch.equal(task.commands, before)
    task.reset_idx(torch.tensor([1]))
    assert torch.equal(task.commands[[0, 2, 3]], before[[0, 2, 3]])
    assert (task.commands[1] != before[1]).all()


def test_published_names_of_files_stand_for_ours(make_task) -> None:
    task = make_task("task=Anymal", "task.env.urdfAsset.file=urdf/anymal_c/urdf/anymal.urdf")
    assert task.simulation.body_names[1] == "LF_HIP"
    with pytest.raises(ConfigError, match=r"task\.env\.urdfAsset\.file='mjcf/dog\.xml': no file"):
        make_task("task=Anymal", "task.env.urdfAsset.file=mjcf/dog.xml")
    with pytest.raises(ConfigError, match=r"task\.env\.asset: .*urdfAsset\.file"):
        make_task("task=Anymal", "+task.env.asset.assetFileName=mjcf/ant.xml")


def test_what_cannot_be_used_is_named(make_task) -> None:
    for override, message in [
        ("task.env.control.controlFrequencyInv=2", "controlFrequencyInv"),
        ("task.env.urdfAsset.fixBaseLink=True", "fixBaseLink"),
        ("+task.env.learn.torqueRewardScal=1", "did you mean 'torqueRewardScale'"),
        ("+task.env.urdfAsset.kneeName=ELBOW", "kneeName='ELBOW': no body name contains it"),
        ("+task.env.defaultJointAngles.TAIL=1", "defaultJointAngles: unknown joint TAIL"),
        ("~task.env.defaultJointAngles.RF_KFE", "defaultJointAngles: missing joint RF_KFE"),
    ]:
        overrides = [override]
        if "torqueRewardScal=" in override:
            overrides.append("~task.env.learn.torqueRewardScale")
        with pytest.raises(ConfigError, match=message):
            make_task("task=Anymal", *overrides)
