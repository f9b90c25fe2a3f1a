"""Making, stepping and closing of simulations; determinism, sensors, contacts and failures."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from mujoco.batch import SimulationError
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation import cpu_batch
from isaacgymenvs_lite.simulation.backend import make_simulation
from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation
from tests.simulation.test_cpu_batch_state import STATE_TENSORS

# Falls freely from 10 m; 0.005 s per physics step.
FALLING_BALL = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="ball" pos="0 0 10"><freejoint/><geom size="0.1"/></body>
</worldbody></mujoco>
"""
PUSHED_SLIDER = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>
</worldbody><actuator><motor joint="rail"/></actuator></mujoco>
"""


def test_numbers_out_of_range() -> None:
    model = mujoco.MjModel.from_xml_string(FALLING_BALL)
    for numbers, message in (
        ((0, 1, 1), "num_envs=0: expected at least 1"),
        ((1, 0, 1), "substeps=0: expected at least 1"),
        ((1, 1, -1), "num_threads=-1: expected at least 0"),
    ):
        with pytest.raises(ConfigError, match=message):
            CpuBatchSimulation(model, *numbers)


def test_a_step_is_so_many_physics_steps(make_simulation) -> None:
    simulation = make_simulation(FALLING_BALL, num_envs=2, substeps=4)
    assert simulation.dt == pytest.approx(0.02)
    simulation.step()
    # Semi-implicit Euler: v = g h k; z = z0 + g h^2 (1 + 2 + ... + k), h = 0.005 s, k = 4 and 8.
    for env in range(2):
        assert float(simulation.root_states[env, 9]) == pytest.approx(-9.81 * 0.02, rel=1e-6)
        assert float(simulation.root_states[env, 2]) == pytest.approx(10.0 - 9.81 * 2.5e-5 * 10)
    simulation.step()
    assert float(simulation.root_states[0, 2]) == pytest.approx(10.0 - 9.81 * 2.5e-5 * 36)


def test_controls_go_to_their_environment(make_simulation) -> None:
    simulation = make_simulation(PUSHED_SLIDER, num_envs=3, substeps=2)
    simulation.set_controls(torch.tensor([[0.0], [1.0], [-4.0]]))
    simulation.step()
    # v = F / m * 2 h with 2 kg and h = 0.01 s
    expected = torch.tensor([[0.0], [0.01], [-0.04]])
    torch.testing.assert_close(simulation.dof_vel, expected, rtol=0.0, atol=1e-8)
    # Controls stay until they are set again.
    simulation.step()
    torch.testing.assert_close(simulation.dof_vel, 2.0 * expected, rtol=0.0, atol=1e-8)


def test_shapes_types_and_device(make_simulation, humanoid_model) -> None:
    simulation = make_simulation(humanoid_model, num_envs=3, substeps=4)
    shapes = {
        "root_states": (3, 13),
        "dof_pos": (3, 28),
        "dof_vel": (3, 28),
        "body_pos": (3, 15, 3),
        "body_rot": (3, 15, 4),
        "body_lin_vel": (3, 15, 3),
        "body_ang_vel": (3, 15, 3),
        "contact_forces": (3, 15, 3),
    }
    for name, shape in shapes.items():
        tensor = getattr(simulation, name)
        assert (tuple(tensor.shape), tensor.dtype) == (shape, torch.float32), name
    assert (tuple(simulation.failed.shape), simulation.failed.dtype) == ((3,), torch.bool)
    assert simulation.device == torch.device("cpu")

    # They are updated in place.
    names = ("root_states", "dof_pos", "dof_vel", "body_pos", "contact_forces", "failed")
    before = {name: getattr(simulation, name) for name in names}
    height = float(before["root_states"][0, 2])
    simulation.step()
    for name, tensor in before.items():
        assert getattr(simulation, name) is tensor, name
    assert float(before["root_states"][0, 2]) < height


def _hundred_steps(simulation: CpuBatchSimulation) -> list[Tensor]:
    """Return the states along 100 steps under random targets, with falls and contacts."""
    generator = torch.Generator().manual_seed(0)
    states = []
    for _ in range(100):
        simulation.set_controls(torch.randn(simulation.num_envs, 28, generator=generator))
        simulation.step()
        poses = simulation.root_states, simulation.dof_pos, simulation.dof_vel
        states.append(torch.cat((*poses, simulation.contact_forces.flatten(1)), dim=-1))
    return states


def test_the_first_hundred_steps_do_not_depend_on_the_threads(
    make_simulation, humanoid_model
) -> None:
    one, two = (
        _hundred_steps(make_simulation(humanoid_model, 7, substeps=4, num_threads=n))
        for n in (1, 2)
    )
    for first, second in zip(one, two, strict=True):
        assert first.numpy().tobytes() == second.numpy().tobytes()
    assert one[-1].isfinite().all()


def test_reading_derived_tensors_does_not_change_the_course(
    make_simulation, humanoid_model
) -> None:
    # They are bound to the batch on first use, in the middle of a run.
    curious, plain = (make_simulation(humanoid_model, 2, substeps=4) for _ in range(2))
    for step in range(40):
        for simulation in (curious, plain):
            simulation.step()
        if step >= 20:
            assert curious.body_rot.isfinite().all()
            assert curious.body_lin_vel.isfinite().all()
        assert torch.equal(curious.root_states, plain.root_states)
        assert torch.equal(curious.contact_forces, plain.contact_forces)
    assert curious.contact_forces.abs().max() > 0.0


def _threads_of_this_process() -> int:
    return len(os.listdir("/proc/self/task"))


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts threads in /proc")
def test_close_ends_the_threads() -> None:
    model = mujoco.MjModel.from_xml_string(FALLING_BALL)
    gc.collect()  # what earlier tests left behind must not end its threads in between
    before = _threads_of_this_process()
    simulation = CpuBatchSimulation(model, 8, 1, num_threads=4)
    assert _threads_of_this_process() == before + 3  # and the caller's
    simulation.step()
    simulation.close()
    # The object itself is still alive, as a task that was closed is.
    assert _threads_of_this_process() == before
    assert simulation.num_envs == 8


def test_use_after_close(make_simulation) -> None:
    simulation = make_simulation(PUSHED_SLIDER)
    simulation.close()
    simulation.close()
    zeros = torch.zeros(1, 13), torch.zeros(1, 1), torch.zeros(1, 1)
    uses = {
        "step": simulation.step,
        "set_controls": lambda: simulation.set_controls(torch.zeros(1, 1)),
        "write_state": lambda: simulation.write_state(torch.tensor([0]), *zeros),
        "body_lin_vel": lambda: simulation.body_lin_vel,
        "body_ang_vel": lambda: simulation.body_ang_vel,
    }
    for name, use in uses.items():
        with pytest.raises(RuntimeError, match="closed"):
            use()
            pytest.fail(f"{name} works after close()")


def test_contact_sensors_in_another_order_are_refused(make_simulation) -> None:
    sensor = '<contact name="contact_%s" body1="%s" data="force" reduce="netforce"/>'
    sensors = sensor % ("b", "b") + sensor % ("a", "a")
    with pytest.raises(ConfigError, match="in body order"):
        make_simulation(
            '<mujoco><worldbody><body name="a"><joint/><geom size="0.1"/></body>'
            '<body name="b" pos="1 0 0"><joint/><geom size="0.1"/></body></worldbody>'
            f"<sensor>{sensors}</sensor></mujoco>"
        )


def test_threads_that_have_too_little_to_do_are_not_made(
    make_simulation, humanoid_model, monkeypatch
) -> None:
    monkeypatch.setattr(cpu_batch, "thread_count", lambda: 4)
    # Some microseconds of work in a step, and some milliseconds.
    assert make_simulation(FALLING_BALL, num_envs=4, num_threads=0).num_threads == 1
    assert make_simulation(humanoid_model, 128, substeps=4, num_threads=0).num_threads == 4
    assert make_simulation(humanoid_model, 2, substeps=40, num_threads=0).num_threads == 2


BALL = """<mujoco><worldbody><body name="ball" pos="0 0 1"><freejoint/><geom size="0.1"/></body>
</worldbody></mujoco>"""


def test_makes_cpu_batch_by_default() -> None:
    model = mujoco.MjModel.from_xml_string(BALL)
    simulation = make_simulation(model, 3, substeps=2, num_threads=1)
    assert isinstance(simulation, CpuBatchSimulation)
    assert (simulation.num_envs, simulation.substeps) == (3, 2)
    assert simulation.model is model
    simulation.close()


def test_an_unknown_backend_lists_the_choices() -> None:
    model = mujoco.MjModel.from_xml_string(BALL)
    with pytest.raises(ConfigError, match=r"'cpu_bach'.*did you mean 'cpu_batch'.*choices: cpu_b"):
        make_simulation(model, 1, 1, backend="cpu_bach")


@pytest.mark.slow
def test_backends_are_imported_only_when_asked_for() -> None:
    code = (
        "import sys, isaacgymenvs_lite.simulation.backend;"
        "sys.exit('isaacgymenvs_lite.simulation.cpu_batch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.3" stiffness="2"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/>
    <site name="tip" pos="0.3 0 0"/>
  </body></worldbody>
  <actuator><motor joint="shoulder"/></actuator>
  <sensor>
    <framepos name="tip" objtype="site" objname="tip"/><jointvel name="speed" joint="shoulder"/>
  </sensor></mujoco>
"""


@pytest.fixture
def arm() -> Iterator[CpuBatchSimulation]:
    simulation = CpuBatchSimulation(mujoco.MjModel.from_xml_string(ARM), 3, 4, 1)
    yield simulation
    simulation.close()


def _stepped(torque: float) -> mujoco.MjData:
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.ctrl[0] = torque
    for _ in range(4):
        mujoco.mj_step(model, data)
    return data


def test_sensors_and_forces_are_those_of_the_last_physics_step(arm: CpuBatchSimulation) -> None:
    assert arm.dof_forces.shape == (3, 1)  # measured from here on
    torques = [0.0, 1.5, -3.0]
    arm.set_controls(torch.tensor(torques).unsqueeze(1))
    arm.step()
    for env, torque in enumerate(torques):
        data = _stepped(torque)
        np.testing.assert_allclose(arm.sensor("tip")[env], data.sensor("tip").data, atol=1e-6)
        np.testing.assert_allclose(arm.sensor("speed")[env], data.sensor("speed").data, rtol=1e-5)
        expected = data.qfrc_actuator + data.qfrc_passive
        np.testing.assert_allclose(arm.dof_forces[env], expected, rtol=1e-5, atol=1e-6)


def test_nothing_was_measured_in_a_state_that_was_written(arm: CpuBatchSimulation) -> None:
    assert arm.dof_forces.shape == (3, 1)
    arm.set_controls(torch.ones(3, 1))
    arm.step()
    arm.write_state(torch.tensor([1]), torch.zeros(1, 13), torch.tensor([[0.4]]), torch.zeros(1, 1))
    for measured in (arm.sensor("tip"), arm.sensor("speed"), arm.dof_forces):
        assert (measured[1] == 0.0).all()
        assert (measured[[0, 2]] != 0.0).any(dim=1).all()
    arm.step()
    assert arm.sensor("tip")[1].norm().item() == pytest.approx(0.3, abs=1e-5)


def test_an_unknown_sensor_is_named(arm: CpuBatchSimulation) -> None:
    with pytest.raises(ConfigError, match=r"unknown sensor of the model 'top' .did you mean 'tip'"):
        arm.sensor("top")


def test_environments_may_differ_in_a_field(arm: CpuBatchSimulation) -> None:
    arm.expand("body_mass")[:, 1] = [1.0, 2.0, 4.0]
    arm.expand("body_inertia")[:, 1] *= np.array([1.0, 2.0, 4.0])[:, None]
    arm.expand("jnt_stiffness")[:] = 0.0
    arm.expand("dof_damping")[:] = 0.0
    arm.expand("opt.gravity")[:] = 0.0
    arm.update_constants(np.arange(3))
    arm.set_controls(torch.ones(3, 1))
    arm.step()
    speeds = arm.dof_vel[:, 0]
    torch.testing.assert_close(speeds * torch.tensor([1.0, 2.0, 4.0]), speeds[:1].expand(3))


def test_bodies_are_where_they_are_asked_for(arm: CpuBatchSimulation) -> None:
    before = arm.body_rot.clone()
    angles = torch.tensor([[0.2], [0.4], [0.6]])
    arm.write_state(torch.arange(3), torch.zeros(3, 13), angles, torch.zeros(3, 1))
    assert (arm.body_rot != before).any()
    torch.testing.assert_close(arm.body_rot[:, 0, 1], (angles[:, 0] / 2).sin())


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


FINITE = [name for name in STATE_TENSORS if name != "failed"]


@pytest.fixture
def pair(make_simulation, humanoid_model) -> tuple[CpuBatchSimulation, CpuBatchSimulation]:
    """Two equal batches of four humanoids, some steps into a run, with ground contact."""
    simulations = [make_simulation(humanoid_model, 4, substeps=4, num_threads=2) for _ in range(2)]
    for simulation in simulations:
        for _ in range(8):
            simulation.step()
    assert simulations[0].contact_forces.abs().max() > 0.0
    return simulations[0], simulations[1]


def _write_dof_velocity(simulation: CpuBatchSimulation, env: int, value: float) -> None:
    ids = torch.tensor([env])
    simulation.write_state(
        ids, simulation.root_states[ids], simulation.dof_pos[ids], torch.full((1, 28), value)
    )


@pytest.mark.parametrize("value", [float("nan"), 1e6])
def test_a_diverged_simulation_is_flagged_counted_and_put_back(pair, value: float) -> None:
    broken, sound = pair
    _write_dof_velocity(broken, 2, value)
    for simulation in pair:
        simulation.step()
    assert broken.failed.tolist() == [False, False, True, False]
    assert broken.num_failures == 1
    # The default state of the model: 1 m above the floor, upright, at rest.
    np.testing.assert_allclose(broken.root_states[2], [0, 0, 1, 0, 0, 0, 1, *[0] * 6], atol=1e-6)
    assert (broken.dof_pos[2] == 0.0).all()
    assert (broken.dof_vel[2] == 0.0).all()
    assert (broken.contact_forces[2] == 0.0).all()
    for name in FINITE:
        assert getattr(broken, name).isfinite().all(), name
    np.testing.assert_allclose(broken.body_pos[2, 0], [0.0, 0.0, 1.0], atol=1e-6)
    others = [0, 1, 3]
    for _ in range(20):
        for name in FINITE:
            assert torch.equal(getattr(broken, name)[others], getattr(sound, name)[others]), name
        for simulation in pair:
            simulation.step()
        # It goes on from there, and is not counted again.
        assert not broken.failed.any()
    assert broken.num_failures == 1
    assert sound.num_failures == 0
    assert float(broken.root_states[2, 2]) < 0.99


def test_nan_written_straight_into_the_batch(pair) -> None:
    simulation, _ = pair
    _write_dof_velocity(simulation, 2, 20.0)  # a fast motion is no failure
    simulation.batch.bind("qvel")[0, 3] = np.nan
    simulation.batch.bind("qpos")[1, 9] = np.inf
    simulation.step()
    assert simulation.failed.tolist() == [True, True, False, False]
    assert simulation.num_failures == 2
    assert simulation.root_states.isfinite().all()


def test_controls_that_are_not_numbers_do_no_harm(pair) -> None:
    simulation, _ = pair
    simulation.set_controls(torch.full((4, 28), float("nan")))
    for _ in range(3):
        simulation.step()
    assert simulation.root_states.isfinite().all()


class _Raising:
    """A batch whose next step raises for some simulations, after it has stepped."""

    def __init__(self, batch, ids: list[int]) -> None:
        self._wrapped = batch
        self._ids = np.array(ids)

    def __getattr__(self, name: str):
        return getattr(self._wrapped, name)

    def step(self, **arguments) -> None:
        self._wrapped.step(**arguments)
        if len(self._ids) > 0:
            ids, self._ids = self._ids, self._ids[:0]
            raise SimulationError(ids, "made up by the test")


def test_an_error_that_mujoco_raises_is_treated_like_a_divergence(pair, monkeypatch) -> None:
    simulation, sound = pair
    raising = {simulation: _Raising(simulation.batch, [1, 3]), sound: sound.batch}
    monkeypatch.setattr(CpuBatchSimulation, "batch", property(lambda self: raising[self]))
    for each in pair:
        each.step()
    assert simulation.failed.tolist() == [False, True, False, True]
    assert simulation.num_failures == 2
    np.testing.assert_allclose(simulation.root_states[[1, 3], 2], 1.0)
    for each in pair:
        each.step()
    assert not simulation.failed.any()
    assert torch.equal(simulation.root_states[[0, 2]], sound.root_states[[0, 2]])


def test_mujoco_writes_no_log_file(pair, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    simulation, _ = pair
    _write_dof_velocity(simulation, 0, float("nan"))
    simulation.step()
    assert simulation.num_failures == 1
    assert list(tmp_path.iterdir()) == []
