"""HumanoidPerturb: which boxes are thrown, when, from where and how fast."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.ase.humanoid_perturb import HumanoidPerturb

# Control steps of the specification's throws; the twelfth box is the large one.
THROWS = (60, 67, 77, 112, 114, 116, 119, 121, 123, 126, 128, 188, 488)
LARGE = 11


@pytest.fixture
def make(make_ase):
    """Return a maker of HumanoidPerturb; episodes start standing."""
    return lambda *args, **env: make_ase(
        *args, cls=HumanoidPerturb, **{"stateInit": "Default", **env}
    )


@pytest.fixture
def throws_of(monkeypatch: pytest.MonkeyPatch):
    """Return `throws_of(task)`, a list that (progress, boxes, states (N, k, 13)) are added to."""

    def note(task: HumanoidPerturb) -> list[tuple[int, list[int], Tensor]]:
        thrown: list[tuple[int, list[int], Tensor]] = []
        write = task.simulation.write_object_states

        def noting(env_ids: Tensor, object_ids: Tensor, states: Tensor) -> None:
            assert env_ids.tolist() == list(range(task.num_envs))
            thrown.append((int(task.progress_buf[0]), object_ids.tolist(), states.clone()))
            write(env_ids, object_ids, states)

        monkeypatch.setattr(task.simulation, "write_object_states", noting)
        return thrown

    return note


# --- boxes ------------------------------------------------------------------------------------


def test_the_boxes_of_the_specification(make) -> None:
    sim = make(1).simulation
    assert len(sim.object_names) == 13
    for i, name in enumerate(sim.object_names):
        edge, mass = (0.5, 12.5) if i == LARGE else (0.2, 1.6)
        assert float(sim.model.body(name).mass[0]) == pytest.approx(mass)
        np.testing.assert_allclose(sim.model.geom(name).size, [edge / 2] * 3)
        # m and m a^2 / 6, a hundredth of it in a second
        first = int(sim.model.joint(name).dofadr[0])
        expected = 0.01 * np.array([mass] * 3 + [mass * edge**2 / 6.0] * 3)
        np.testing.assert_allclose(sim.model.dof_damping[first : first + 6], expected)


# --- when -------------------------------------------------------------------------------------


def test_boxes_are_thrown_in_their_order_and_time(make, throws_of) -> None:
    # The clock is the progress of the first environment, modulo 489, before the step is counted.
    task = make(2, episodeLength=2000)
    task.reset()
    thrown = throws_of(task)
    zeros = task.zero_actions()
    for progress in [*range(55, 70), *range(110, 130), 188, 488, 489 + 60, 489 + 188]:
        task.progress_buf[0] = progress
        task.progress_buf[1] = 3
        task.pre_physics_step(zeros)
    times = [(progress, boxes) for progress, boxes, _ in thrown]
    expected = [(step, [box]) for box, step in enumerate(THROWS) if step != 77]
    assert times == [*expected, (489 + 60, [0]), (489 + 188, [LARGE])]


# --- from where and how fast ------------------------------------------------------------------


def test_a_throw_is_aimed_at_the_torso(make, throws_of) -> None:
    torch.manual_seed(0)
    task = make(16, stateInit="Random")
    task.reset()
    sim = task.simulation
    for _ in range(3):
        task.step(task.zero_actions())
    torso, root = sim.body_pos[:, 1].clone(), sim.root_states[:, :2].clone()
    drift = sim.body_lin_vel[:, 1].clone()
    assert root[:, 0].max() > 1.0
    assert drift[:, :2].norm(dim=-1).min() > 0.3
    thrown = throws_of(task)
    for _ in range(20):
        task.throw(5)
    states = torch.stack([box[:, 0] for *_, box in thrown])
    assert states.shape == (20, 16, 13)
    offsets = states[..., :2] - root
    distances, heights = offsets.norm(dim=-1), states[..., 2]
    # 320 throws come near both ends of the ranges.
    for values, low, high in ((distances, 4.0, 5.0), (heights, 0.25, 2.0)):
        near = 0.02 * (high - low)
        assert low - 1e-5 <= values.min() < low + near
        assert high - near < values.max() <= high + 1e-5
    # From all sides: the mean of the directions has a standard deviation of 0.04.
    assert (offsets / distances.unsqueeze(-1)).mean(dim=(0, 1)).abs().max() < 0.2
    assert (states[..., 3:7] == torch.tensor([0.0, 0.0, 0.0, 1.0])).all()
    assert (states[..., 10:] == 0.0).all()
    # Without the torso's own horizontal velocity a throw has 30 to 40 m/s.
    velocities = states[..., 7:10].clone()
    velocities[..., :2] -= drift[:, :2]
    speeds = velocities.norm(dim=-1)
    assert 30.0 - 1e-4 <= speeds.min() < 30.2
    assert 39.8 < speeds.max() <= 40.0 + 1e-4
    # Where the line of flight passes the torso: the noise of 0.1 m across it has two components,
    # of which the mean length is 0.1 sqrt(pi / 2).
    ways = torso - states[..., :3]
    along = (ways * velocities).sum(-1, keepdim=True) * velocities / speeds.unsqueeze(-1) ** 2
    missed = (ways - along).norm(dim=-1)
    assert (ways * velocities).sum(-1).min() > 0.0
    assert float(missed.mean()) == pytest.approx(0.125, abs=0.02)
    assert missed.max() < 0.6


# --- ends of episodes -------------------------------------------------------------------------


def test_only_time_ends_an_episode(make) -> None:
    for enable_early_termination in [False, True]:
        task = make(2, episodeLength=6, enableEarlyTermination=enable_early_termination)
        task.reset()
        root = torch.zeros(1, 13)
        root[0, 2:7] = torch.tensor([0.085, 0.0, -(0.5**0.5), 0.0, 0.5**0.5])  # on its back
        zeros = torch.zeros(1, 28)
        task.simulation.write_state(torch.tensor([1]), root, zeros, zeros)
        seen = []
        for _ in range(5):
            *_, dones, infos = task.step(task.zero_actions())
            assert infos["terminate"].tolist() == [0, 0]
            assert infos["time_outs"].tolist() == [bool(done) for done in dones]
            seen.append(dones.tolist())
        assert seen == [[0, 0]] * 4 + [[1, 1]]
