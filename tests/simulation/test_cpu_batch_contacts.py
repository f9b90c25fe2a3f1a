"""Net contact forces on the bodies."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

GRAVITY = 9.81
# The weight of a body at rest: the soft contacts of MuJoCo hold it exactly, once it has settled.
SETTLED = 1e-3

# 2 kg of ball on 5 kg of plate on the floor; the plate slides on a rail along z only.
STACK = """
<mujoco><option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="ball" pos="0 0 0.3"><freejoint/><geom size="0.1" mass="2"/></body>
    <body name="plate" pos="0 0 0.1"><joint name="lift" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.4 0.4 0.1" mass="5"/></body>
  </worldbody>
  <sensor>
    <contact name="contact_ball" body1="ball" data="force" reduce="netforce"/>
    <contact name="contact_plate" body1="plate" data="force" reduce="netforce"/>
  </sensor>
</mujoco>
"""


def test_forces_on_a_stack(make_simulation) -> None:
    simulation = make_simulation(STACK, num_envs=2, substeps=10)
    for _ in range(100):
        simulation.step()
    for env in range(2):
        ball, plate = simulation.contact_forces[env].numpy()
        # The plate carries the ball; the floor both: up by 7 g, down by 2 g.
        np.testing.assert_allclose(ball, [0.0, 0.0, 2.0 * GRAVITY], atol=SETTLED)
        np.testing.assert_allclose(plate, [0.0, 0.0, 5.0 * GRAVITY], atol=SETTLED)


def _lying(n: int, height_m: float = 0.25) -> torch.Tensor:
    """Root states (n, 13) of humanoids on their back, above the floor."""
    root = torch.zeros(n, 13)
    root[:, 2] = height_m
    root[:, 3:7] = torch.tensor([0.0, -0.70710678, 0.0, 0.70710678])
    return root


def test_a_lying_humanoid_weighs_what_it_weighs(make_simulation, humanoid_model) -> None:
    simulation = make_simulation(humanoid_model, num_envs=1, substeps=4)
    zeros = torch.zeros(1, 28)
    simulation.write_state(torch.tensor([0]), _lying(1), zeros, zeros)
    for _ in range(60):  # 2 s with all joints held at zero
        simulation.step()
    forces = simulation.contact_forces[0]
    assert simulation.dof_vel.abs().max() < 1e-4
    total = forces.sum(dim=0).numpy()
    np.testing.assert_allclose(total[:2], 0.0, atol=0.01)
    np.testing.assert_allclose(total[2], 48.8908 * GRAVITY, rtol=1e-4)
    # Nothing pulls a body down, and the arms and legs carry some of it.
    assert (forces[:, 2] > -1e-3).all()
    assert (forces[:, 2] > 1.0).sum() >= 4


def test_forces_are_those_of_the_last_physics_step(
    make_simulation, humanoid_model, random_state
) -> None:
    # Limbs touch each other and the floor. The oracle: the same steps by mj_step, whose contacts
    # are those of its last step.
    simulation = make_simulation(humanoid_model, num_envs=1, substeps=4)
    root, dof_pos, _ = random_state(1, seed=0)
    root[:, 2], root[:, 7:] = 0.35, 0.0
    zeros = torch.zeros(1, 28)
    simulation.write_state(torch.tensor([0]), root, dof_pos, zeros)
    targets = 2.0 * dof_pos.flip(-1)
    simulation.set_controls(targets)
    data = simulation.batch.get_data(0)
    self_touched = 0
    for _ in range(30):
        simulation.step()
        for _ in range(4):
            mujoco.mj_step(humanoid_model, data)
        expected = np.zeros((16, 3))
        for index in range(data.ncon):
            contact = data.contact[index]
            force = np.zeros(6)
            mujoco.mj_contactForce(humanoid_model, data, index, force)
            in_world = contact.frame.reshape(3, 3).T @ force[:3]
            first, second = humanoid_model.geom_bodyid[contact.geom]
            # MuJoCo's force is the one of the first geom on the second.
            expected[second] += in_world
            expected[first] -= in_world
            self_touched += int(first > 0 and second > 0)
        # float32 of forces up to some 10 kN
        np.testing.assert_allclose(
            simulation.contact_forces[0].numpy(), expected[1:], rtol=1e-5, atol=1e-3
        )
    assert self_touched > 10


def test_forces_of_written_environments_are_zero(make_simulation, humanoid_model) -> None:
    simulation = make_simulation(humanoid_model, num_envs=3, substeps=4)
    zeros = torch.zeros(3, 28)
    simulation.write_state(torch.arange(3), _lying(3, height_m=0.08), zeros, zeros)
    assert (simulation.contact_forces == 0.0).all()
    simulation.step()
    before = simulation.contact_forces.clone()
    assert (before.abs().amax(dim=(1, 2)) > 1.0).all()
    simulation.write_state(torch.tensor([1]), _lying(1, height_m=0.08), zeros[:1], zeros[:1])
    assert (simulation.contact_forces[1] == 0.0).all()
    assert torch.equal(simulation.contact_forces[[0, 2]], before[[0, 2]])
    # Tensors that are computed on demand do not bring them back.
    assert simulation.body_lin_vel.isfinite().all()
    assert (simulation.contact_forces[1] == 0.0).all()
