"""The backend's forces, Jacobians, mass matrices and contact sensors for arms and hands."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation.backend import SimulationBackend, make_simulation

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005" gravity="0 0 0"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="link1" pos="0.1 0.2 0.8" euler="0.3 0 0.2">
      <joint name="j1" axis="0 0 1" armature="0.01"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
      <body name="link2" pos="0.3 0 0" euler="0 0.4 0">
        <joint name="j2" axis="0 1 0" pos="0.02 0 0.01"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0.1"/>
        <body name="gripper" pos="0.2 0 0.1">
          <joint name="slide" type="slide" axis="1 0.2 0"/>
          <geom type="box" size="0.02 0.03 0.04"/>
        </body>
      </body>
    </body>
    <body name="door" pos="-0.5 0 0.5">
      <joint name="hinge" axis="0 0 1"/>
      <geom type="box" size="0.02 0.3 0.2" pos="0 0.3 0"/>
    </body>
    <body name="ball" pos="-2 0 1"><freejoint/><geom size="0.1" density="300"/></body>
  </worldbody>
  <sensor>
    <contact name="contact_gripper" body1="gripper" data="force" reduce="netforce"/>
  </sensor>
</mujoco>
"""
DOFS = ("j1", "j2", "slide")
N = 5


@pytest.fixture
def simulation() -> SimulationBackend:
    torch.manual_seed(3)
    made = make_simulation(mujoco.MjModel.from_xml_string(ARM), N, substeps=2)
    _write(made, torch.arange(N))
    return made


def _write(simulation: SimulationBackend, env_ids: torch.Tensor) -> None:
    n = len(env_ids)
    pos, vel = 0.5 * torch.randn(n, 4), torch.randn(n, 4)
    simulation.write_state(env_ids, torch.zeros(n, 13), pos, vel)


def _expected(simulation: SimulationBackend) -> tuple[np.ndarray, np.ndarray]:
    """Return MuJoCo's own Jacobians (N, 6, 3) of the gripper and mass matrices (N, 3, 3)."""
    model, data = simulation.model, mujoco.MjData(simulation.model)
    jacobians, matrices = [], []
    for dof_pos in simulation.dof_pos.numpy():
        data.qpos[:4] = dof_pos
        mujoco.mj_forward(model, data)
        jacobian = np.zeros((2, 3, model.nv))
        mujoco.mj_jacBody(model, data, *jacobian, model.body("gripper").id)
        matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        jacobians.append(jacobian.reshape(6, -1)[:, :3])
        matrices.append(matrix[:3, :3])
    return np.stack(jacobians), np.stack(matrices)


def test_jacobian_and_mass_matrix_are_mujocos(simulation: SimulationBackend) -> None:
    for step in range(4):
        if step == 2:  # some environments have a state that no step has seen
            _write(simulation, torch.tensor([1, 3]))
        jacobians, matrices = _expected(simulation)
        # float32 positions of about 1 m
        np.testing.assert_allclose(simulation.jacobian("gripper", DOFS), jacobians, atol=1e-6)
        np.testing.assert_allclose(simulation.mass_matrix(DOFS), matrices, rtol=1e-5, atol=1e-7)
        simulation.step()


def test_jacobian_maps_joint_velocities_to_body_velocities(simulation: SimulationBackend) -> None:
    velocity = simulation.jacobian("gripper", DOFS) @ simulation.dof_vel[:, :3, None]
    gripper = simulation.body_names.index("gripper")
    measured = (simulation.body_lin_vel[:, gripper], simulation.body_ang_vel[:, gripper])
    torch.testing.assert_close(velocity[..., 0], torch.cat(measured, dim=-1), atol=1e-5, rtol=1e-5)


def test_dofs_have_the_given_order(simulation: SimulationBackend) -> None:
    jacobian, matrix = simulation.jacobian("gripper", DOFS), simulation.mass_matrix(DOFS)
    order = [2, 0]
    names = [DOFS[i] for i in order]
    torch.testing.assert_close(simulation.jacobian("gripper", names), jacobian[:, :, order])
    torch.testing.assert_close(simulation.mass_matrix(names), matrix[:, order][:, :, order])
    assert simulation.mass_matrix(["hinge", "j1"])[0, 0, 1] == 0.0  # no common body


def test_mass_matrices_follow_the_masses_of_environments(simulation: SimulationBackend) -> None:
    before = simulation.mass_matrix(DOFS)
    gripper = simulation.model.body("gripper").id
    simulation.expand("body_mass")[2, gripper] *= 2.0
    after = simulation.mass_matrix(DOFS)
    torch.testing.assert_close(after[[0, 1, 3, 4]], before[[0, 1, 3, 4]], rtol=0, atol=0)
    # The mass of the sliding body is the entry of the slide.
    torch.testing.assert_close(after[2, 2, 2], 2.0 * before[2, 2, 2])


def test_a_force_acts_on_the_centre_of_mass_for_one_step(simulation: SimulationBackend) -> None:
    mass = float(simulation.model.body("ball").mass[0])
    forces = torch.randn(N, 1, 3)
    simulation.apply_forces(["ball"], forces)
    simulation.step()
    speed = simulation.object_states[:, 0, 7:10].clone()
    torch.testing.assert_close(speed, forces[:, 0] / mass * simulation.dt, rtol=1e-4, atol=1e-6)
    assert float(simulation.object_states[:, 0, 10:].abs().max()) < 1e-5
    simulation.step()
    torch.testing.assert_close(simulation.object_states[:, 0, 7:10], speed, rtol=1e-5, atol=1e-6)


def test_forces_on_bodies_are_in_world_axes(simulation: SimulationBackend) -> None:
    _, matrices = _expected(simulation)
    simulation.write_state(
        torch.arange(N), torch.zeros(N, 13), simulation.dof_pos.clone(), torch.zeros(N, 4)
    )
    model, data = simulation.model, mujoco.MjData(simulation.model)
    force, expected = torch.tensor([0.5, -1.0, 2.0]), []
    for dof_pos in simulation.dof_pos.numpy():
        data.qpos[:4] = dof_pos
        mujoco.mj_forward(model, data)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacBodyCom(model, data, jacobian, None, model.body("gripper").id)
        expected.append(jacobian[:, :3].T @ force.numpy())
    simulation.apply_forces(["gripper"], force.expand(N, 1, 3))
    simulation.step()
    momentum = matrices @ simulation.dof_vel[:, :3, None].numpy()
    # In 10 ms the mass matrix and the Jacobian change by less than a percent.
    np.testing.assert_allclose(momentum[..., 0], np.stack(expected) * simulation.dt, rtol=2e-2)


def test_a_new_state_removes_forces(simulation: SimulationBackend) -> None:
    simulation.apply_forces(["ball"], torch.ones(N, 1, 3))
    _write(simulation, torch.tensor([2]))
    simulation.step()
    moves = simulation.object_states[:, 0, 7:10].norm(dim=-1) > 0
    assert moves.tolist() == [True, True, False, True, True]


def test_bodies_without_contact_sensors_have_no_force() -> None:
    near_floor = ARM.replace("0.1 0.2 0.8", "0.1 0.2 -0.05")
    simulation = make_simulation(mujoco.MjModel.from_xml_string(near_floor), 1, substeps=1)
    simulation.step()
    pushed = simulation.contact_forces[0].norm(dim=-1) > 0  # link1 and link2 touch the floor, too
    assert pushed.tolist() == [name == "gripper" for name in simulation.body_names]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.jacobian("griper", DOFS), "did you mean 'gripper'"),
        (lambda s: s.mass_matrix(["j3"]), "degree of freedom of the model"),
        (lambda s: s.apply_forces(["cube"], torch.zeros(N, 1, 3)), "body of the model"),
    ],
)
def test_unknown_names(simulation: SimulationBackend, call, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        call(simulation)


def test_joint_forces_do_not_contain_the_compensation_of_gravity() -> None:
    spec = mujoco.MjSpec.from_string(ARM.replace('gravity="0 0 0"', 'gravity="0 0 -10"'))
    for body in spec.bodies:
        body.gravcomp = 1.0
    spec.joint("j2").stiffness[0] = 3.0
    simulation = make_simulation(spec.compile(), N, substeps=1)
    _ = simulation.dof_forces  # measured from here on
    _write(simulation, torch.arange(N))
    spring = -3.0 * simulation.dof_pos[:, 1]  # forces of the start of the step
    simulation.step()
    torch.testing.assert_close(simulation.dof_forces[:, 1], spring)
    assert (simulation.dof_forces[:, [0, 2, 3]] == 0.0).all()
