"""Shows how a simulation diverged: isaacgymenvs-lite replay FILE.

    isaacgymenvs-lite replay runs/Ant_22-10-15-30/diverged/0001.npz
    isaacgymenvs-lite replay 0001.npz task=Ant task.sim.dt=0.02

A training writes FILE, which contains the states before the last control steps, into `diverged/` of
its run folder. The command computes the steps again. For each physics step it prints the largest
acceleration and the largest speed, with the names of their joints. The model comes from the run's
config.yaml or from the settings after FILE.
"""

from __future__ import annotations

import argparse
import copy
import logging
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import EXIT_USER_ERROR, ConfigError, UserError
from isaacgymenvs_lite.simulation.cpu_batch import MAX_SPEED
from isaacgymenvs_lite.simulation.recording import Recording, model_identity, read_recording

log = logging.getLogger(__name__)

ModelMaker = Callable[[Path, list[str]], mujoco.MjModel]
"""Maps a recording's file and the user's settings (`task=...`) to the compiled model."""

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


@dataclass(frozen=True)
class Largest:
    """The largest absolute speed or acceleration in a physics step, and the name of its joint.

    The unit is rad/s or m/s for a speed, rad/s^2 or m/s^2 for an acceleration. The value is nan or
    inf if any value of the step is not finite.
    """

    value: float
    joint: str


@dataclass(frozen=True)
class PhysicsStep:
    """A physics step of a replay."""

    control_step: int  # index in the recording; the oldest step has the index 0
    physics_step: int  # index in the control step
    time_s: float  # simulated time after the step, since the start of the recording
    acceleration: Largest  # `qacc` of the step, rad/s^2 or m/s^2
    speed: Largest  # `qvel` after the step, rad/s or m/s; in world axes for free joints
    is_sound: bool  # whether the state is finite and no joint is faster than `MAX_SPEED`


def replay(recording: Recording, model: mujoco.MjModel) -> Iterator[PhysicsStep]:
    """Yield the physics steps of a recording, up to the first unsound state.

    Raises:
        ConfigError: states or fields of the recording do not fit the model.
    """
    model = _own_model(recording, model)
    data = mujoco.MjData(model)
    names = [_joint_of(model, dof) for dof in range(model.nv)]
    for control_step, state in enumerate(recording.states):
        mujoco.mj_setState(model, data, state, _STATE)
        for physics_step in range(recording.substeps):
            mujoco.mj_step(model, data)
            speed = _largest(_world_velocities(model, data), names)
            is_sound = bool(np.isfinite(data.qpos).all()) and speed.value <= MAX_SPEED
            done = control_step * recording.substeps + physics_step + 1
            time_s, acceleration = done * model.opt.timestep, _largest(data.qacc, names)
            yield PhysicsStep(control_step, physics_step, time_s, acceleration, speed, is_sound)
            if not is_sound:
                return


def _own_model(recording: Recording, model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of the model that has the recording's fields and is never reset by MuJoCo."""
    size = mujoco.mj_stateSize(model, _STATE)
    if recording.states.shape[1] != size:
        raise ConfigError(
            f"the recording's states have {recording.states.shape[1]} values, but the model's have"
            f" {size}: the recording belongs to another model; give its settings, task=NAME"
        )
    model = copy.copy(model)
    # MuJoCo would reset the diverged state, which the replay must show.
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    for name, values in recording.fields.items():
        _write_field(model, name, values)
    if recording.fields:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _write_field(model: mujoco.MjModel, name: str, values: npt.NDArray[Any]) -> None:
    """Set a field of the model, for example `geom_friction` or `opt.gravity`."""
    owner = model.opt if name.startswith("opt.") else model
    own = getattr(owner, name.removeprefix("opt."), None)
    if isinstance(own, float) and values.ndim == 0 and owner is model.opt:
        setattr(owner, name.removeprefix("opt."), float(values))
        return
    fits = isinstance(own, np.ndarray) and own.dtype.kind == "f" and own.shape == values.shape
    if not fits or values.dtype.kind != "f" or not isinstance(own, np.ndarray):
        raise ConfigError(
            f"the recording has a field '{name[:40]}' of shape {values.shape}, but the model has no"
            " such field of this shape"
        )
    own[:] = values


def _world_velocities(model: mujoco.MjModel, data: mujoco.MjData) -> npt.NDArray[np.float64]:
    """Return qvel with the angular velocities of free joints in world axes."""
    velocities = data.qvel.copy()
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        rotation = data.qpos[model.jnt_qposadr[joint] + 3 :][:4]
        angular = velocities[model.jnt_dofadr[joint] + 3 :][:3]
        mujoco.mju_rotVecQuat(angular, angular.copy(), rotation)
    return velocities


def _joint_of(model: mujoco.MjModel, dof: int) -> str:
    joint = int(model.dof_jntid[dof])
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"joint {joint}"


def _largest(values: npt.NDArray[np.float64], joints: list[str]) -> Largest:
    if len(values) == 0:
        return Largest(0.0, "-")
    sizes = np.abs(values)
    place = int(np.argmax(np.where(np.isfinite(sizes), sizes, np.inf)))
    return Largest(float(sizes[place]), joints[place])


def table(recording: Recording, model: mujoco.MjModel) -> Iterator[str]:
    """Yield the lines of a recording's table."""
    first = recording.control_step
    of_task = f" of {recording.task}" if recording.task else ""
    yield f"environment {recording.env_id}{of_task}, control steps {first} to" + (
        f" {first + len(recording.states) - 1}, {recording.substeps} physics steps each"
    )
    if model_identity(model) != recording.model_id:
        yield "the recording belongs to another model: give the settings of its training"
    widest = max((len(_joint_of(model, dof)) for dof in range(model.nv)), default=5)
    yield f"{'step':>10} {'time (s)':>9} {'max |qacc|':>11} {'joint':{widest}}" + (
        f" {'max |qvel|':>11} joint"
    )
    last = None
    for last in replay(recording, model):
        yield (
            f"{first + last.control_step:>7}.{last.physics_step:<2} {last.time_s:9.4f}"
            f" {last.acceleration.value:11.4g} {last.acceleration.joint:{widest}}"
            f" {last.speed.value:11.4g} {last.speed.joint}"
        )
    if last is None or last.is_sound:
        yield "the simulation does not diverge with this model"
    else:
        faster = f"is faster than {MAX_SPEED:g} rad/s or m/s"
        yield (
            f"diverged in control step {first + last.control_step}, physics step"
            f" {last.physics_step}: {last.speed.joint}"
            f" {faster if np.isfinite(last.speed.value) else 'is not finite'}"
        )


def main(arguments: list[str] | None, make_model: ModelMaker) -> int:
    """Run the command line; `make_model` makes the model, because this package has no tasks."""
    parser = argparse.ArgumentParser(
        prog="isaacgymenvs-lite replay",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", type=Path, help="a file of <run>/diverged/")
    parser.add_argument("words", metavar="task=NAME key=value", nargs="*", help="as for train.py")
    given = parser.parse_args(arguments)
    try:
        recording = read_recording(given.file)
        for line in table(recording, make_model(given.file, given.words)):
            sys.stdout.write(line + "\n")
    except UserError as error:
        sys.stderr.write(f"error: {error}\n")
        return EXIT_USER_ERROR
    return 0


if __name__ == "__main__":
    from isaacgymenvs_lite.env_factory import model_of_recording

    sys.exit(main(None, model_of_recording))
