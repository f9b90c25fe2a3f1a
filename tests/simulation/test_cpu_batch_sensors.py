"""Sensors, joint forces and fields by environment, against MuJoCo's own step."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation

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
