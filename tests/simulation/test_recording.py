"""The last steps of a diverged simulation: kept, written, read, computed again."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation import replay
from isaacgymenvs_lite.simulation.recording import Recording, read_recording, write_recording

# A pendulum under a motor, and one that is far too strong for the timestep.
PENDULUM = """
<mujoco><option timestep="0.01"/><worldbody>
  <body><joint name="shoulder" axis="0 1 0"/><geom size="0.1" pos="0 0 -1"/>
    <body pos="0 0 -1"><joint name="elbow" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.5"/></body>
  </body></worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow" gear="1e6"/></actuator></mujoco>
"""


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PENDULUM)


@pytest.fixture
def recorded(make_simulation: Callable[..., Any], model: mujoco.MjModel) -> Recording:
    """The recording of the second of three simulations, which an insane torque tore apart."""
    simulation = make_simulation(model, 3, substeps=5)
    damping = simulation.expand("dof_damping")
    damping[1] = 0.125
    simulation.update_constants(np.arange(3))
    controls = torch.zeros(3, 2)
    controls[:, 0] = 0.3
    for _ in range(6):
        simulation.set_controls(controls)
        simulation.step()
    controls[1, 1] = 1.0
    simulation.set_controls(controls)
    before = np.array(simulation.batch.state[1])
    simulation.step()
    assert simulation.failed.tolist() == [False, True, False]
    (recording,) = simulation.recordings
    np.testing.assert_array_equal(recording.states[-1], before)
    return recording


def test_the_replay_is_the_simulation_bit_by_bit(recorded: Recording, model) -> None:
    """The end of each replayed control step is the state before the next one."""
    assert (recorded.env_id, recorded.substeps, recorded.control_step) == (1, 5, 3)
    assert len(recorded.states) == 4
    assert recorded.fields["dof_damping"].tolist() == [0.125, 0.125]
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    steps = list(replay.replay(recorded, model))
    sound = [step for step in steps if step.control_step < 3]
    assert len(sound) == 15
    assert all(step.is_sound for step in sound)
    speeds = np.abs(recorded.states[1:, 1 + model.nq : 1 + model.nq + model.nv]).max(axis=1)
    assert [step.speed.value for step in sound[4::5]] == speeds.tolist()


def test_the_replay_names_step_and_joint(recorded: Recording, model) -> None:
    last = list(replay.replay(recorded, model))[-1]
    assert (last.control_step, last.is_sound) == (3, False)
    assert last.speed.joint == "elbow"
    assert last.speed.value > 1000.0
    assert model.dof_damping.tolist() == [0.0, 0.0]  # the caller's model is unchanged
    lines = list(replay.table(recorded, model))
    assert lines[0] == "environment 1, control steps 3 to 6, 5 physics steps each"
    assert lines[-1].startswith(f"diverged in control step 6, physics step {last.physics_step}:")
    assert "elbow" in lines[-1]
    assert len(lines) == 3 + 15 + last.physics_step + 1


def test_a_file_holds_all_of_it(recorded: Recording, tmp_path: Path) -> None:
    path = tmp_path / "diverged" / "0001.npz"
    write_recording(path, recorded)
    assert path.stat().st_size < 10_000
    read = read_recording(path)
    np.testing.assert_array_equal(read.states, recorded.states)
    np.testing.assert_array_equal(read.fields["dof_damping"], recorded.fields["dof_damping"])
    for name in ("substeps", "model_id", "env_id", "control_step", "task"):
        assert getattr(read, name) == getattr(recorded, name)


def test_a_simulation_that_was_put_somewhere_starts_a_new_recording(
    make_simulation: Callable[..., Any], model: mujoco.MjModel
) -> None:
    simulation = make_simulation(model, 2)
    for _ in range(5):
        simulation.step()
    simulation.write_state(
        torch.tensor([0]), torch.zeros(1, 13), torch.zeros(1, 2), torch.full((1, 2), torch.nan)
    )
    simulation.step()
    (recording,) = simulation.recordings
    assert len(recording.states) == 1
    (step,) = replay.replay(recording, model)
    assert not step.is_sound


def test_only_the_first_few_wait_for_somebody(make_simulation, model) -> None:
    simulation = make_simulation(model, 20)
    broken = torch.full((20, 2), torch.nan)
    simulation.write_state(torch.arange(20), torch.zeros(20, 13), torch.zeros(20, 2), broken)
    simulation.step()
    assert simulation.num_failures == 20
    assert [recording.env_id for recording in simulation.recordings] == list(range(8))


def test_another_model_is_named_or_refused(recorded: Recording) -> None:
    heavier = mujoco.MjModel.from_xml_string(PENDULUM.replace('size="0.1"', 'size="0.2"'))
    assert any("belongs to another model" in line for line in replay.table(recorded, heavier))
    cart = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ConfigError, match="another model; give its settings"):
        list(replay.table(recorded, cart))


def archive(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


GOOD = {
    "format": np.array("isaacgymenvs_lite.diverged"),
    "version": np.array(1),
    "states": np.zeros((1, 30)),
    "model_id": np.array("x"),
    "task": np.array(""),
    "env_id": np.array(0),
    "control_step": np.array(0),
    "substeps": np.array(1),
}


HOSTILE = (
    (b"states: 1", "not a readable recording"),
    (archive(**GOOD)[:-200], "not a readable recording"),
    (archive(states=np.array([{}], dtype=object)), "not a readable recording"),
    (archive(**{**GOOD, "version": np.array(2)}), "has the format"),
    (archive(**{**GOOD, "states": np.zeros(3)}), "has no states"),
)


def test_a_file_that_is_none_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "0001.npz"
    for content, message in HOSTILE:
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=message) as caught:
            read_recording(path)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) <= 500


def test_fields_that_do_not_fit_are_refused(model) -> None:
    states = np.zeros((1, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION)))
    for field in ("dof_damping", "nv", "__class__", "opt.gravity", "names"):
        recording = Recording(states, 1, "", {field: np.zeros(7)})
        with pytest.raises(ConfigError, match="but the model has no such field"):
            list(replay.replay(recording, model))


def test_the_command_prints_the_table(recorded: Recording, model, tmp_path: Path, capsys) -> None:
    path = tmp_path / "0001.npz"
    write_recording(path, recorded)
    given = []

    def make_model(file: Path, words: list[str]) -> mujoco.MjModel:
        given.append((file, words))
        return model

    assert replay.main([str(path), "task=Pendulum"], make_model) == 0
    assert given == [(path, ["task=Pendulum"])]
    assert "diverged in control step 6" in capsys.readouterr().out
    assert replay.main([str(tmp_path / "none.npz")], make_model) == 2
    assert capsys.readouterr().err.count("\n") == 1
