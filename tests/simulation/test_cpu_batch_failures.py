"""Simulations that diverge are flagged, counted and put back; the others go on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from mujoco.batch import SimulationError

from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation

FINITE = (
    "root_states",
    "dof_pos",
    "dof_vel",
    "body_pos",
    "body_rot",
    "body_lin_vel",
    "body_ang_vel",
    "contact_forces",
)


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
