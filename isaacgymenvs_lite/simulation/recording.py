"""Keeps the last control steps of simulations, and writes the steps before a divergence to a file.

A diverged simulation is reset. To keep the steps before the divergence, `StepHistory` copies the
state before each control step. A `Recording` contains these states of one simulation and is stored
in a small .npz file. `replay` computes the steps again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError, UserError, one_line
from isaacgymenvs_lite.utils.files import written_for_user

Doubles = npt.NDArray[np.float64]

_FORMAT = "isaacgymenvs_lite.diverged"
_VERSION = 1
# Number of control steps in a recording.
_STEPS = 4
_FIELD = "model."
_NUMBERS = ("env_id", "control_step", "substeps")
# Randomisation may change these arrays of a task's model.
_IDENTITY = (
    *("qpos0", "body_pos", "body_mass", "body_inertia", "jnt_range", "dof_damping", "dof_armature"),
    *("geom_size", "geom_friction", "actuator_gainprm", "actuator_biasprm", "hfield_data"),
)


@dataclass(frozen=True)
class Recording:
    """The last control steps of a simulation before it diverged."""

    # (K, S) MuJoCo's `mjSTATE_INTEGRATION` before each control step; it includes the controls.
    states: Doubles
    substeps: int  # physics steps of a control step
    model_id: str  # see `model_identity`
    # Maps names of model fields to this simulation's values.
    fields: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    env_id: int = 0  # index of the environment
    control_step: int = 0  # number of the recording's last control step in the task
    task: str = ""  # name of the task; '' if it is unknown


class StepHistory:
    """Keeps the states of N simulations before each of their last control steps.

    `rows` (N, S) is a view of the current states. Only the first `num_changing` values of a state
    are copied. No task changes the remaining values, so a returned state has the remaining values
    of the first simulation.
    """

    def __init__(self, rows: Doubles, num_changing: int) -> None:
        self._rows = rows[:, :num_changing]
        self._others = rows[0, num_changing:].copy()
        self._ring = np.empty((_STEPS, *self._rows.shape))
        self._added = 0
        self._started = np.zeros(len(rows), dtype=np.int64)

    @property
    def added(self) -> int:
        """Number of calls of `add` so far."""
        return self._added

    def add(self) -> None:
        """Copy the current states before a control step."""
        np.copyto(self._ring[self._added % _STEPS], self._rows)
        self._added += 1

    def restart(self, env_ids: npt.NDArray[np.integer]) -> None:
        """Forget the stored states of n simulations whose current state was set."""
        self._started[env_ids] = self._added

    def states(self, env_id: int) -> Doubles:
        """Return a copy of a simulation's states (K, S) since its last restart, oldest first."""
        first = max(int(self._started[env_id]), self._added - _STEPS)
        steps = [i % _STEPS for i in range(first, self._added)]
        others = np.broadcast_to(self._others, (len(steps), len(self._others)))
        return np.concatenate((self._ring[steps, env_id], others), axis=1)


def model_identity(model: mujoco.MjModel) -> str:
    """Return a text that identifies a model; randomised parameters do not change the text."""
    digest = hashlib.sha256(bytes(model.names))
    digest.update(np.float64(model.opt.timestep).tobytes())
    for name in _IDENTITY:
        digest.update(np.ascontiguousarray(getattr(model, name)).tobytes())
    return digest.hexdigest()[:16]


def write_recording(path: Path, recording: Recording) -> None:
    """Write a recording to an .npz file."""
    arrays: dict[str, Any] = {
        "format": np.array(_FORMAT),
        "version": np.array(_VERSION),
        "states": recording.states,
        "model_id": np.array(recording.model_id),
        "task": np.array(recording.task),
        **{name: np.array(getattr(recording, name)) for name in _NUMBERS},
        **{_FIELD + name: values for name, values in recording.fields.items()},
    }
    with written_for_user(path, "recording") as partial, partial.open("wb") as stream:
        np.savez(stream, **arrays)


def read_recording(path: Path) -> Recording:
    """Read a file of `write_recording` without running code that the file contains."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; expected <run>/diverged/<name>.npz")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        found = (str(arrays.get("format")), str(arrays.get("version")))
        if found != (_FORMAT, str(_VERSION)):
            raise ConfigError(
                f"{path} has the format {found}, expected {(_FORMAT, str(_VERSION))}; give a file"
                " of <run>/diverged/"
            )
        states = arrays["states"]
        if states.ndim != 2 or states.dtype != np.float64 or states.size == 0:
            raise ConfigError(f"{path} has no states (control steps, values) of type float64")
        return Recording(
            states=states,
            model_id=str(arrays["model_id"]),
            fields={n.removeprefix(_FIELD): v for n, v in arrays.items() if n.startswith(_FIELD)},
            task=str(arrays["task"]),
            **{name: int(arrays[name]) for name in _NUMBERS},
        )
    except UserError:
        raise
    except Exception as error:  # numpy and zipfile raise many types of errors
        raise ConfigError(
            f"{path} is not a readable recording ({one_line(error)[:200]}); expected a file"
            " <run>/diverged/<name>.npz of a training"
        ) from error
