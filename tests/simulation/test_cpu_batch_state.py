"""The state tensors against MuJoCo's own functions, and writing of states."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.simulation.state_buffers import (
    StateBuffers,
    StateConverter,
    as_tensor,
)

# Two trees; the first has a bent chain of two.
TWO_TREES = """
<mujoco><worldbody>
  <body name="a" pos="0 0 1"><joint name="shoulder" type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
    <body name="b" pos="0.3 0 0"><joint name="elbow" type="hinge" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/></body></body>
  <body name="c" pos="2 0 1"><joint name="other" type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/></body>
</worldbody></mujoco>
"""
STATE_TENSORS = (
    "root_states",
    "dof_pos",
    "dof_vel",
    "body_pos",
    "body_rot",
    "body_lin_vel",
    "body_ang_vel",
    "contact_forces",
    "failed",
)
# float32 of numbers of order 1 (positions, velocities up to about 10): a few roundings
ATOL = 5e-6


def _oracle(simulation: CpuBatchSimulation, env: int) -> mujoco.MjData:
    """MuJoCo's own data of an environment, with all fields of its present state."""
    data = simulation.batch.get_data(env)
    mujoco.mj_forward(simulation.model, data)
    return data


def _object_velocity(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """Angular and linear velocity (6,) of a body's origin in world axes."""
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
    return velocity


def _assert_bodies_are_mujoco_s(simulation: CpuBatchSimulation, env: int) -> None:
    data = _oracle(simulation, env)
    bodies = range(1, simulation.model.nbody)
    velocities = np.array([_object_velocity(simulation.model, data, body) for body in bodies])
    expected = {
        "body_pos": data.xpos[1:],
        "body_rot": data.xquat[1:][:, [1, 2, 3, 0]],
        "body_ang_vel": velocities[:, :3],
        "body_lin_vel": velocities[:, 3:],
    }
    for name, values in expected.items():
        actual = getattr(simulation, name)[env].numpy()
        np.testing.assert_allclose(actual, values, rtol=1e-6, atol=ATOL, err_msg=name)


def test_tensors_after_steps_are_mujoco_s(make_simulation, humanoid_model, random_state) -> None:
    simulation = make_simulation(humanoid_model, num_envs=3, substeps=4)
    simulation.write_state(torch.arange(3), *random_state(3, seed=0))
    simulation.set_controls(torch.full((3, 28), 0.3))
    for _ in range(3):
        simulation.step()
    for env in range(3):
        data = _oracle(simulation, env)
        _assert_bodies_are_mujoco_s(simulation, env)
        pelvis = _object_velocity(simulation.model, data, 1)
        root = np.concatenate((data.xpos[1], data.xquat[1][[1, 2, 3, 0]], pelvis[3:], pelvis[:3]))
        np.testing.assert_allclose(simulation.root_states[env].numpy(), root, rtol=1e-6, atol=ATOL)
        np.testing.assert_allclose(simulation.dof_vel[env].numpy(), data.qvel[6:], rtol=1e-6)
        # The length of the actuators is the position of their degree of freedom.
        np.testing.assert_allclose(
            simulation.dof_pos[env].numpy(), data.actuator_length, rtol=1e-6, atol=1e-6
        )


def test_velocities_of_bodies_of_several_trees(make_simulation) -> None:
    simulation = make_simulation(TWO_TREES, num_envs=2)
    simulation.write_state(
        torch.tensor([1]),
        torch.zeros(1, 13),
        torch.tensor([[0.1, 0.2, 0.3]]),
        torch.tensor([[1.0, 2.0, 3.0]]),
    )
    # The origin of c lies on its axis: it turns at 3 rad/s and stays where it is.
    np.testing.assert_allclose(simulation.body_ang_vel[1, 2].numpy(), [0.0, 3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(simulation.body_lin_vel[1, 2].numpy(), 0.0, atol=1e-6)
    _assert_bodies_are_mujoco_s(simulation, 1)


def test_a_written_state_is_read_back(make_simulation, humanoid_model, random_state) -> None:
    simulation = make_simulation(humanoid_model, num_envs=6, substeps=4)
    simulation.step()
    ids = torch.tensor([4, 0, 3])
    assert _bytes(simulation)  # tensors that were read before the write must not stay
    root, dof_pos, dof_vel = random_state(3, seed=1)
    dof_pos[0] = 0.0
    dof_pos[1, :3] = 0.0
    simulation.write_state(ids, root, dof_pos, dof_vel)
    torch.testing.assert_close(simulation.dof_pos[ids], dof_pos, rtol=0.0, atol=2e-6)
    torch.testing.assert_close(simulation.dof_vel[ids], dof_vel, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(simulation.root_states[ids], root, rtol=0.0, atol=2e-6)
    # All tensors are current at once, not only after a step.
    for env in ids.tolist():
        _assert_bodies_are_mujoco_s(simulation, env)


def test_rotation_vectors_longer_than_pi_come_back_short(make_simulation, humanoid_model) -> None:
    simulation = make_simulation(humanoid_model)
    root = torch.zeros(1, 13)
    root[0, 2], root[0, 6] = 3.0, 1.0
    dof_pos = torch.zeros(1, 28)
    dof_pos[0, 6] = 4.0  # the same rotation as 4 - 2 pi
    simulation.write_state(torch.tensor([0]), root, dof_pos, torch.zeros(1, 28))
    assert float(simulation.dof_pos[0, 6]) == pytest.approx(4.0 - 2.0 * np.pi, abs=2e-6)


def test_writing_to_nobody_does_nothing(make_simulation, humanoid_model) -> None:
    simulation = make_simulation(humanoid_model, num_envs=2)
    before = _bytes(simulation)
    none = torch.zeros(0, dtype=torch.int64)
    simulation.write_state(none, torch.zeros(0, 13), torch.zeros(0, 28), torch.zeros(0, 28))
    assert _bytes(simulation) == before


def _bytes(simulation: CpuBatchSimulation, envs: list[int] | None = None) -> dict[str, bytes]:
    """The bytes of all state tensors and of the integration state of some environments."""
    rows = list(range(simulation.num_envs)) if envs is None else envs
    found = {name: getattr(simulation, name)[rows].numpy().tobytes() for name in STATE_TENSORS}
    # qpos, qvel, controls, warm start: all that the future depends on
    found["integration state"] = np.asarray(simulation.batch.state)[rows].tobytes()
    return found


def _stirred(make_simulation, model: mujoco.MjModel, random_state) -> CpuBatchSimulation:
    """Six humanoids with ground contact, in the middle of a run."""
    simulation = make_simulation(model, num_envs=6, substeps=4, num_threads=2)
    root, dof_pos, dof_vel = random_state(6, seed=3)
    root[:, 2] = 0.8
    simulation.write_state(torch.arange(6), root, dof_pos, dof_vel)
    simulation.set_controls(0.2 * dof_pos)
    for _ in range(15):
        simulation.step()
    return simulation


def test_a_reset_leaves_the_others_and_their_future_bit_identical(
    make_simulation, humanoid_model, random_state
) -> None:
    disturbed = _stirred(make_simulation, humanoid_model, random_state)
    quiet = _stirred(make_simulation, humanoid_model, random_state)
    others = [0, 2, 3, 5]
    before = _bytes(disturbed, others)
    assert quiet.contact_forces[others].abs().max() > 0.0
    disturbed.write_state(torch.tensor([1, 4]), *random_state(2, seed=4))
    assert _bytes(disturbed, others) == before
    for _ in range(20):
        for simulation in (disturbed, quiet):
            simulation.step()
        assert _bytes(disturbed, others) == _bytes(quiet, others)


def test_a_written_state_has_no_memory(make_simulation, humanoid_model, random_state) -> None:
    # The same state in an environment with a past and in a new one: the same bytes from there on.
    used = _stirred(make_simulation, humanoid_model, random_state)
    fresh = make_simulation(humanoid_model, num_envs=6, substeps=4)
    root, dof_pos, dof_vel = random_state(1, seed=5)
    root[:, 2] = 0.7
    for simulation in (used, fresh):
        simulation.write_state(torch.tensor([2]), root, dof_pos, dof_vel)
    for _ in range(20):
        assert _bytes(used, [2]) == _bytes(fresh, [2])
        for simulation in (used, fresh):
            simulation.step()
    assert fresh.contact_forces[2].abs().max() > 0.0


def test_rows_and_back(humanoid_model, random_state) -> None:
    layout = ModelLayout.from_model(humanoid_model)
    converter = StateConverter(humanoid_model, layout)
    root, dof_pos, dof_vel = random_state(5, seed=0)
    qpos, qvel = converter.rows(root, dof_pos, dof_vel)
    assert (qpos.shape, qvel.shape) == ((5, 43), (5, 34))
    assert (qpos.dtype, qvel.dtype) == (np.float64, np.float64)
    buffers = StateBuffers(layout, 5)
    converter.fill(buffers, qpos, qvel)
    for buffer, expected in (
        (buffers.root_states, root),
        (buffers.dof_pos, dof_pos),
        (buffers.dof_vel, dof_vel),
    ):
        torch.testing.assert_close(as_tensor(buffer), expected, rtol=0.0, atol=2e-6)
    assert not buffers.bodies_are_current
    converter.fill_bodies(buffers)
    np.testing.assert_allclose(buffers.body_pos[:, 0], root[:, :3].T, atol=1e-6)


def test_the_length_of_the_root_s_quaternion_does_not_scale_its_velocity(
    humanoid_model, random_state
) -> None:
    # Clips hold rotations whose length is off by some 1e-6.
    layout = ModelLayout.from_model(humanoid_model)
    converter = StateConverter(humanoid_model, layout)
    root, dof_pos, dof_vel = random_state(3, seed=0)
    root[:, 3:7] *= torch.tensor([[1.01], [0.9], [0.0]])
    buffers = StateBuffers(layout, 3)
    converter.fill(buffers, *converter.rows(root, dof_pos, dof_vel))
    torch.testing.assert_close(
        as_tensor(buffers.root_states)[:, 10:], root[:, 10:], rtol=0.0, atol=2e-6
    )
