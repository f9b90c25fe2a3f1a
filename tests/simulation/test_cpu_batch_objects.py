"""Free objects beside the robot: their states, forces and writes."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation
from isaacgymenvs_lite.simulation.state_buffers import StateBuffers, StateConverter, as_tensor

GRAVITY = 9.81
# A robot of two bodies and three objects of 2, 3 and 4 kg on the floor, `lid` upon `crate`. Islands
# and warm start are on, as MuJoCo has them by default. qpos: 8 of the robot, then 7 of each object.
ROOM = """
<mujoco><option timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body name="robot" pos="0 0 0.1"><freejoint/><geom type="box" size="0.2 0.2 0.1" mass="6"/>
      <body name="arm" pos="0 0 0.12"><joint name="turn" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/></body></body>
    <body name="ball" pos="1 0 0.1"><freejoint/><geom size="0.1" mass="2"/></body>
    <body name="crate" pos="2 0 0.1" quat="0.8 0 0 0.6">
      <freejoint/><geom type="box" size="0.3 0.2 0.1" mass="3"/></body>
    <body name="lid" pos="2 0 0.25"><freejoint/>
      <geom type="box" size="0.1 0.1 0.05" pos="0 0.01 0" mass="4"/></body>
  </worldbody>
  <actuator><position joint="turn" kp="5" kv="0.5"/></actuator>
  <sensor>%s</sensor>
</mujoco>
"""
ROBOT_BODIES, OBJECTS = ("robot", "arm"), ("ball", "crate", "lid")
NUM_ROBOT_QPOS, NUM_ROBOT_QVEL = 8, 7
ROBOT_TENSORS = (
    *("root_states", "dof_pos", "dof_vel", "body_pos", "body_rot"),
    *("body_lin_vel", "body_ang_vel", "contact_forces", "failed"),
)
TENSORS = (*ROBOT_TENSORS, "object_states", "object_contact_forces")


def _room(*bodies: str) -> str:
    sensor = '<contact name="contact_{0}" body1="{0}" data="force" reduce="netforce"/>'
    return ROOM % "".join(sensor.format(body) for body in bodies)


@pytest.fixture
def make_room(make_simulation):
    def make(num_envs: int, substeps: int = 5) -> CpuBatchSimulation:
        return make_simulation(_room(*ROBOT_BODIES, *OBJECTS), num_envs, substeps, num_threads=2)

    return make


def _random_object_states(n: int, k: int, seed: int) -> Tensor:
    """Tumbling objects (n, k, 13) some metres above the floor."""
    states = torch.randn(n, k, 13, generator=torch.Generator().manual_seed(seed))
    states[..., 2] = 2.0 + states[..., 2].abs()
    states[..., 3:7] /= states[..., 3:7].norm(dim=-1, keepdim=True)
    return states


def _write_state(simulation: CpuBatchSimulation, env_ids: list[int], seed: int = 0) -> None:
    """Put robots of some environments above the floor, turned and moving."""
    root = _random_object_states(len(env_ids), 1, seed)[:, 0]
    ones = torch.ones(len(env_ids), 1)
    simulation.write_state(torch.tensor(env_ids), root, 0.5 * ones, ones)


def _stirred(simulation: CpuBatchSimulation) -> CpuBatchSimulation:
    """Everything fell and lies about, with contacts between robot, objects and floor."""
    everybody = torch.arange(simulation.num_envs)
    _write_state(simulation, everybody.tolist())
    states = _random_object_states(simulation.num_envs, 3, seed=1)
    states[..., :2] *= 0.2
    simulation.write_object_states(everybody, torch.arange(3), states)
    simulation.set_controls(torch.ones(simulation.num_envs, 1))
    for _ in range(160):
        simulation.step()
    assert (simulation.object_contact_forces.abs().amax(dim=(1, 2)) > 1.0).all()
    return simulation


def _bytes(simulation: CpuBatchSimulation, env_ids: list[int]) -> dict[str, bytes]:
    found = {name: getattr(simulation, name)[env_ids].numpy().tobytes() for name in TENSORS}
    found["integration state"] = np.asarray(simulation.batch.state)[env_ids].tobytes()
    return found


def _assert_states_are_mujoco_s(simulation: CpuBatchSimulation, env: int) -> None:
    model, data = simulation.model, simulation.batch.get_data(env)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(simulation.body_pos[env], data.xpos[1:3], rtol=0.0, atol=2e-6)
    velocity = np.zeros(6)  # angular first
    for place in range(3):
        body = 3 + place
        mujoco.mj_objectVelocity(
            model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, flg_local=0
        )
        expected = np.concatenate(
            (data.xpos[body], data.xquat[body][[1, 2, 3, 0]], velocity[3:], velocity[:3])
        )
        # float32 of numbers up to about 10
        np.testing.assert_allclose(
            simulation.object_states[env, place], expected, rtol=1e-6, atol=2e-6
        )


def test_names_and_shapes(make_room) -> None:
    simulation = make_room(4)
    assert simulation.object_names == OBJECTS
    assert simulation.body_names == ROBOT_BODIES
    assert simulation.dof_names == ("turn",)
    shapes = [tuple(getattr(simulation, name).shape) for name in TENSORS]
    of_robot = [(4, 13), (4, 1), (4, 1), (4, 2, 3), (4, 2, 4), (4, 2, 3), (4, 2, 3), (4, 2, 3)]
    assert shapes == [*of_robot, (4,), (4, 3, 13), (4, 3, 3)]
    assert simulation.object_states.dtype == torch.float32
    before = simulation.object_states
    simulation.step()
    assert simulation.object_states is before


def test_written_objects_are_read_back(make_room) -> None:
    simulation = _stirred(make_room(4))
    _assert_states_are_mujoco_s(simulation, 1)
    before = simulation.object_states.clone()
    env_ids, object_ids = torch.tensor([3, 0]), torch.tensor([2, 0])
    states = _random_object_states(2, 2, seed=3)
    simulation.write_object_states(env_ids, object_ids, states)
    for i, env in enumerate(env_ids.tolist()):
        for j, place in enumerate(object_ids.tolist()):
            torch.testing.assert_close(
                simulation.object_states[env, place], states[i, j], rtol=0.0, atol=1e-6
            )
        assert torch.equal(simulation.object_states[env, 1], before[env, 1])
        _assert_states_are_mujoco_s(simulation, env)
    assert torch.equal(simulation.object_states[[1, 2]], before[[1, 2]])
    # The same bytes as a conversion of all states gives.
    written, batch = simulation.object_states.clone(), simulation.batch
    layout = simulation.layout
    buffers = StateBuffers(layout, simulation.num_envs)
    StateConverter(simulation.model, layout).fill(buffers, batch.bind("qpos"), batch.bind("qvel"))
    assert torch.equal(as_tensor(buffers.object_states), written)


def test_a_write_leaves_the_rest_bit_identical(make_room) -> None:
    disturbed, quiet = _stirred(make_room(4)), _stirred(make_room(4))
    written, others = [3, 1], [0, 2]
    before = _bytes(disturbed, others)
    robots = {name: getattr(disturbed, name)[written].clone() for name in ROBOT_TENSORS}
    rows = {name: disturbed.batch.bind(name)[written].copy() for name in ("qpos", "qvel", "ctrl")}
    disturbed.write_object_states(
        torch.tensor(written), torch.tensor([1]), _random_object_states(2, 1, seed=4)
    )
    for name, tensor in robots.items():
        assert torch.equal(getattr(disturbed, name)[written], tensor), name
    for name, first, last in (("qpos", 15, 22), ("qvel", 13, 19)):
        changed = disturbed.batch.bind(name)[written] != rows[name]
        assert changed[:, first:last].any(axis=1).all()
        assert not np.delete(changed, np.s_[first:last], axis=1).any()
    np.testing.assert_array_equal(disturbed.batch.bind("ctrl")[written], rows["ctrl"])
    assert _bytes(disturbed, others) == before
    for _ in range(10):
        for simulation in (disturbed, quiet):
            simulation.step()
        assert _bytes(disturbed, others) == _bytes(quiet, others)


def test_what_follows_a_write_depends_on_the_state_alone(make_room) -> None:
    # A new MjData has no warm start; MuJoCo takes the same steps from the same state.
    simulation = _stirred(make_room(2))
    states = simulation.object_states[1:, :1].clone()
    states[..., 2] += 0.3
    assert np.abs(simulation.batch.bind("qacc_warmstart")[1]).max() > 0.0
    simulation.write_object_states(torch.tensor([1]), torch.tensor([0]), states)
    data = mujoco.MjData(simulation.model)
    for name in ("qpos", "qvel", "ctrl"):
        getattr(data, name)[:] = simulation.batch.bind(name)[1]
    for _ in range(10):
        simulation.step()
        for _ in range(simulation.substeps):
            mujoco.mj_step(simulation.model, data)
        np.testing.assert_array_equal(simulation.batch.bind("qpos")[1], data.qpos)


def test_a_written_robot_has_its_objects_put_back(make_room) -> None:
    simulation = _stirred(make_room(3))
    before = simulation.object_states.clone()
    _write_state(simulation, [2, 1])
    expected = torch.zeros(3, 13)
    expected[:, 0] = torch.tensor([1.0, 2.0, 2.0])
    expected[:, 2] = torch.tensor([0.1, 0.1, 0.25])
    expected[:, 6] = torch.tensor([1.0, 0.8, 1.0])
    expected[1, 5] = 0.6
    for env in (1, 2):
        torch.testing.assert_close(simulation.object_states[env], expected, rtol=0.0, atol=1e-6)
        assert (simulation.object_contact_forces[env] == 0.0).all()
        _assert_states_are_mujoco_s(simulation, env)
    assert torch.equal(simulation.object_states[0], before[0])


def test_forces_on_objects_at_rest(make_room) -> None:
    simulation = make_room(2, substeps=10)
    for _ in range(100):
        simulation.step()
    ball, crate, lid = simulation.object_contact_forces[1].numpy()
    # The floor carries crate and lid, 7 g, of which the lid takes 4 g down. The soft contacts hold
    # the weight exactly once all has settled.
    for force, mass_kg in ((ball, 2.0), (crate, 3.0), (lid, 4.0)):
        np.testing.assert_allclose(force, [0.0, 0.0, mass_kg * GRAVITY], atol=2e-3)
    robot = simulation.contact_forces[1].numpy()
    np.testing.assert_allclose(robot.sum(axis=0), [0.0, 0.0, 7.0 * GRAVITY], atol=2e-3)


def test_forces_of_written_objects_are_zero(make_room) -> None:
    simulation = _stirred(make_room(2))
    before = simulation.object_contact_forces.clone()
    on_robots = simulation.contact_forces.clone()
    states = _random_object_states(1, 2, seed=5)
    simulation.write_object_states(torch.tensor([1]), torch.tensor([2, 1]), states)
    assert (simulation.object_contact_forces[1, 1:] == 0.0).all()
    assert torch.equal(simulation.object_contact_forces[1, 0], before[1, 0])
    assert torch.equal(simulation.object_contact_forces[0], before[0])
    assert torch.equal(simulation.contact_forces, on_robots)


def test_objects_without_contact_sensors_report_no_forces(make_simulation) -> None:
    simulation = make_simulation(_room(*ROBOT_BODIES), substeps=10)
    for _ in range(20):
        simulation.step()
    assert (simulation.object_contact_forces == 0.0).all()
    assert simulation.contact_forces.abs().max() > 1.0


@pytest.mark.parametrize(("column", "value"), [(11, 2e3), (0, float("nan"))])
def test_a_diverged_object_is_a_failure(make_room, column: int, value: float) -> None:
    broken, sound = _stirred(make_room(3)), _stirred(make_room(3))
    states = _random_object_states(1, 1, seed=6)
    states[..., column] = value
    broken.write_object_states(torch.tensor([1]), torch.tensor([2]), states)
    for simulation in (broken, sound):
        simulation.step()
    assert broken.failed.tolist() == [False, True, False]
    assert broken.num_failures == 1
    np.testing.assert_allclose(broken.object_states[1, :, 0], [1.0, 2.0, 2.0])
    np.testing.assert_allclose(broken.root_states[1, :3], [0.0, 0.0, 0.1], atol=1e-6)
    assert _bytes(broken, [0, 2]) == _bytes(sound, [0, 2])
    broken.step()
    assert not broken.failed.any()
