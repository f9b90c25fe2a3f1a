"""Ant: formulas by hand, the model against its table, what the ground and the motors do."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.ant import Ant, compute_ant_reward
from isaacgymenvs_lite.tasks.base.locomotion import (
    LocomotionConfig,
    TorsoState,
    compute_potentials,
    compute_torso_state,
    running_terms,
    unscale,
)
from isaacgymenvs_lite.utils.rotations import normalize, quat_rotate_inverse

DT = 0.0166


def root_states(pos: list[float], rot: list[float], *velocities: float) -> Tensor:
    rotation = normalize(torch.tensor([rot]))
    moving = torch.tensor([list(velocities) or [0.0] * 6])
    return torch.cat((torch.tensor([pos]), rotation, moving), dim=-1)


def torso(**changes: float) -> TorsoState:
    values = {"height": 0.5, "up_proj": 0.5, "heading_proj": 0.4, **changes}
    zeros = torch.zeros(3, 1)
    return TorsoState(
        lin_vel=zeros,
        ang_vel=zeros,
        yaw=zeros[0],
        roll=zeros[0],
        angle_to_target=zeros[0],
        **{name: torch.tensor([value]) for name, value in values.items()},
    )


def reward(state: TorsoState, actions: Tensor, share: Tensor, speed: Tensor) -> dict[str, float]:
    progress = torch.tensor([1.5])
    terms = compute_ant_reward(state, progress, actions, share, speed, LocomotionConfig())
    return {name: term.item() for name, term in terms.items()}


def test_check_values_of_the_specification() -> None:
    states = root_states([2.0, -1.0, 0.5], [0.1, -0.2, 0.3, 0.9])
    found = compute_torso_state(states)
    assert found.up_proj.item() == pytest.approx(0.894737, abs=1e-6)
    assert found.heading_proj.item() == pytest.approx(0.726843, abs=1e-6)
    assert found.angle_to_target.item() == pytest.approx(-0.627572, abs=1e-6)
    # A float32 of this size has steps of 0.004.
    potential = compute_potentials(states[:, :3], DT).item()
    assert potential == pytest.approx(-60120.512109, abs=0.01)


def test_velocities_are_those_in_the_torsos_axes() -> None:
    states = root_states([0.0, 0.0, 0.5], [0.3, -0.1, 0.5, 0.8], 1.0, 2.0, 3.0, -4.0, 5.0, 6.0)
    found = compute_torso_state(states)
    rotation = states[:, 3:7]
    for given, local in ((states[:, 7:10], found.lin_vel), (states[:, 10:], found.ang_vel)):
        torch.testing.assert_close(local.t(), quat_rotate_inverse(rotation, given))


def test_terms_by_hand() -> None:
    actions = torch.tensor([[1.0, -0.5, *[0.0] * 6]])
    share = torch.tensor([[1.0, 0.98, -1.0, *[0.0] * 5]])  # lower limits cost nothing, as published
    speed = torch.tensor([[2.0, 4.0, *[9.0] * 6]])
    terms = reward(torso(), actions, share, speed)
    assert terms == pytest.approx(
        {
            "progress": 1.5,
            "alive": 0.5,
            "heading": 0.5 * 0.4 / 0.8,
            "up": 0.0,
            "actions": -0.005 * 1.25,
            "energy": -0.05 * (2.0 + 2.0),
            "joints_at_limit": -0.1,
            "fall": 0.0,
        }
    )


def test_a_fall_costs_two_and_nothing_else_counts() -> None:
    terms = reward(torso(height=0.3), torch.ones(1, 8), torch.ones(1, 8), torch.ones(1, 8))
    assert sum(terms.values()) == terms["fall"] == -2.0


def test_heading_and_uprightness_are_paid_in_full_from_their_thresholds() -> None:
    shares = torch.tensor([-0.4, 0.4, 0.79, 0.81, 1.0])
    expected = torch.tensor([-0.25, 0.25, 0.49375, 0.5, 0.5])
    torso = compute_torso_state(root_states([0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]))
    torso = torso._replace(heading_proj=shares, up_proj=torch.tensor([0.92, 0.94, 0.0, 0.0, 0.0]))
    terms = running_terms(torso, torch.zeros(5), torch.zeros(5, 8), 0.5, LocomotionConfig())
    torch.testing.assert_close(terms["heading"], expected)
    torch.testing.assert_close(terms["up"], torch.tensor([0.0, 0.1, 0.0, 0.0, 0.0]))


@pytest.fixture
def ant(make_task) -> Ant:
    return make_task("task=Ant", num_envs=8)


def test_the_model_is_that_of_the_tables(ant: Ant) -> None:
    model, sim = ant.simulation.model, ant.simulation
    assert sim.dof_names == tuple(f"{kind}_{i}" for i in range(1, 5) for kind in ("hip", "ankle"))
    masses = {name: model.body(name).mass[0] for name in sim.body_names}
    assert masses["torso"] == pytest.approx(0.3272 + 4 * 0.03916, abs=2e-4)
    assert masses["front_left_leg"] == pytest.approx(0.03916, abs=1e-5)
    assert masses["right_back_foot"] == pytest.approx(0.06759, abs=1e-5)
    lower = [-40, 30, -40, -100, -40, -100, -40, 30]
    upper = [40, 100, 40, -30, 40, -30, 40, 100]
    torch.testing.assert_close(ant.dof_limits_lower.rad2deg(), torch.tensor(lower).float())
    torch.testing.assert_close(ant.dof_limits_upper.rad2deg(), torch.tensor(upper).float())
    expected = [0, 0.5236, 0, -0.5236, 0, -0.5236, 0, 0.5236]
    torch.testing.assert_close(ant.initial_dof_pos, torch.tensor(expected), atol=1e-4, rtol=0)
    assert (model.dof_armature[6:] == 0.01).all()
    assert (model.dof_damping[6:] == 0.1).all()


def stand(ant: Ant) -> None:
    n = ant.num_envs
    root = ant.initial_root.repeat(n, 1)
    pos = ant.initial_dof_pos.repeat(n, 1)
    ant.simulation.write_state(torch.arange(n), root, pos, torch.zeros_like(pos))


def test_it_rests_on_its_feet_which_feel_its_weight(ant: Ant) -> None:
    ant.reset()
    stand(ant)
    for _ in range(100):
        ant.step(ant.zero_actions())
    # Feet at 30 degrees below the horizontal, of length 0.4 sqrt(2) m and radius 0.08 m.
    expected = 0.4 * math.sqrt(2.0) * math.sin(math.radians(30.0)) + 0.08
    heights = ant.simulation.root_states[:, 2]
    assert heights.mean().item() == pytest.approx(expected, abs=0.02)
    forces = ant.foot_wrenches().reshape(4, 6, ant.num_envs)[:, :3]
    weight = ant.simulation.model.body_mass.sum() * 9.81
    # Flat on the ground the feet's frames are those of the tilted legs: lengths count.
    assert forces.norm(dim=1).sum(0).mean().item() == pytest.approx(weight, rel=0.3)
    assert ant.obs_buf[:, 28:52].abs().max() > 0.0


def test_a_full_action_is_15_nm(ant: Ant, controls_of) -> None:
    controls = controls_of(ant)
    ant.step(torch.eye(8))
    torch.testing.assert_close(controls[0], 15.0 * torch.eye(8))


def test_progress_is_the_speed_along_x_and_nothing_after_a_reset(ant: Ant) -> None:
    ant.reset()
    ant.step(ant.zero_actions())
    ant.reset_buf[:] = 1
    ant.step(ant.zero_actions())
    # One step of float32 at 60,000 is 0.004.
    assert ant.reward_terms["progress"].abs().max() < 0.01
    n = ant.num_envs
    root = ant.initial_root.repeat(n, 1)
    root[:, 2], root[:, 7] = 5.0, 3.0
    ant.simulation.write_state(
        torch.arange(n), root, ant.initial_dof_pos.repeat(n, 1), torch.zeros(n, 8)
    )
    ant.step(ant.zero_actions())
    _, _, _, infos = ant.step(ant.zero_actions())
    torch.testing.assert_close(
        ant.reward_terms["progress"], torch.full((n,), 3.0), rtol=0, atol=0.02
    )
    torch.testing.assert_close(infos["true_objective"], torch.full((n,), 3.0), rtol=0, atol=1e-3)


def test_the_observation_piece_by_piece(ant: Ant) -> None:
    ant.reset()
    actions = torch.linspace(-1, 1, 64).reshape(8, 8)
    for _ in range(5):
        observed = ant.step(actions)[0]["obs"]
    sim, state = ant.simulation, compute_torso_state(ant.simulation.root_states)
    torch.testing.assert_close(observed[:, 0], sim.root_states[:, 2])
    torch.testing.assert_close(observed[:, 1:4], state.lin_vel.t())
    torch.testing.assert_close(observed[:, 4:7], state.ang_vel.t())
    angles = torch.stack((state.yaw, state.roll, state.angle_to_target), dim=-1)
    torch.testing.assert_close(observed[:, 7:10], angles)
    projections = torch.stack((state.up_proj, state.heading_proj), dim=-1)
    torch.testing.assert_close(observed[:, 10:12], projections)
    share = unscale(sim.dof_pos, ant.dof_limits_lower, ant.dof_limits_upper)
    torch.testing.assert_close(observed[:, 12:20], share)
    torch.testing.assert_close(observed[:, 20:28], 0.2 * sim.dof_vel)
    torch.testing.assert_close(observed[:, 28:52], 0.1 * ant.foot_wrenches().t())
    torch.testing.assert_close(observed[:, 52:], actions)


def test_starts_are_spread_and_within_the_limits(make_task) -> None:
    ant = make_task("task=Ant", num_envs=500)
    ant.reset()
    pos, vel = ant.simulation.dof_pos, ant.simulation.dof_vel
    assert (pos >= ant.dof_limits_lower - 1e-6).all()
    assert (pos <= ant.dof_limits_upper + 1e-6).all()
    assert (pos - ant.initial_dof_pos).abs().max() <= 0.2 + 1e-6
    assert pos[:, 0].std().item() == pytest.approx(0.4 / math.sqrt(12.0), rel=0.1)
    assert vel.abs().max() <= 0.1
    torch.testing.assert_close(ant.simulation.root_states, ant.initial_root.repeat(500, 1))
