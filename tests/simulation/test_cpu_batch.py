"""Making, stepping and closing of the simulations; determinism."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import mujoco
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation import cpu_batch
from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation

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
