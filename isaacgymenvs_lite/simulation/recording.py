"""Keeps the last control steps of simulations, and files of those that diverged.

A simulation that diverges is reset, so that what led to it would be lost. `StepHistory` copies the
complete state before each control step; `Recording` is what it kept of one simulation, written to
and read from a small .npz file. `replay` computes the steps again.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.utils.files import written_for_user

Doubles = npt.NDArray[np.float64]

_FORMAT = "isaacgymenvs_lite.diverged"
_VERSION = 1
# Control steps of a recording.
_STEPS = 4
_FIELD = "model."
_NUMBERS = ("env_id", "control_step", "substeps")
_MAX_FILE_BYTES = 8 * 2**20
_MAX_ENTRIES = 64
_MAX_STEPS = 16
_MAX_SUBSTEPS = 1000
_MAX_TEXT = 200
# Arrays in which two models of one task differ, if they do.
_IDENTITY = (
    *("qpos0", "body_pos", "body_mass", "body_inertia", "jnt_range", "dof_damping", "dof_armature"),
    *("geom_size", "geom_friction", "actuator_gainprm", "actuator_biasprm", "hfield_data"),
)
# What numpy and the archive reader raise for a damaged file or another format.
_READ_ERRORS = (
    *(OSError, ValueError, EOFError, RuntimeError, MemoryError, SyntaxError, NotImplementedError),
    *(zipfile.BadZipFile, zlib.error),
)


@dataclass(frozen=True)
class Recording:
    """The last control steps of a simulation that diverged in the last of them.

    Attributes:
        states: (K, S) MuJoCo's `mjSTATE_INTEGRATION` before each control step, controls included.
        substeps: physics steps of a control step.
        model_id: see `model_identity`.
        fields: values of the model's fields that this simulation has for itself, by name.
        env_id: its environment.
        control_step: control steps of the task before the last one of the recording.
        task: name of the task; '' if it is not known.
    """

    states: Doubles
    substeps: int
    model_id: str
    fields: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    env_id: int = 0
    control_step: int = 0
    task: str = ""


class StepHistory:
    """Keeps the states of N simulations before each of their last control steps.

    Args:
        rows: (N, S) their current states, a view that the simulation writes to.
    """

    def __init__(self, rows: Doubles) -> None:
        self._rows = rows
        self._ring = np.empty((_STEPS, *rows.shape))
        self._added = 0
        self._started = np.zeros(len(rows), dtype=np.int64)

    @property
    def added(self) -> int:
        """States added so far, of each simulation."""
        return self._added

    def add(self) -> None:
        """Copy the current states; to be called before a control step."""
        np.copyto(self._ring[self._added % _STEPS], self._rows)
        self._added += 1

    def restart(self, env_ids: npt.NDArray[np.integer]) -> None:
        """Start anew for simulations (n,) whose state was written."""
        self._started[env_ids] = self._added

    def states(self, env_id: int) -> Doubles:
        """Return a copy of the states (K, S) of a simulation since its last start, oldest first."""
        first = max(int(self._started[env_id]), self._added - _STEPS)
        return np.array([self._ring[i % _STEPS, env_id] for i in range(first, self._added)])


def model_identity(model: mujoco.MjModel) -> str:
    """Return a text that two models share if they are the same but for randomised parameters."""
    digest = hashlib.sha256(bytes(model.names))
    digest.update(np.float64(model.opt.timestep).tobytes())
    for name in _IDENTITY:
        digest.update(np.ascontiguousarray(getattr(model, name)).tobytes())
    return digest.hexdigest()[:16]


def write_recording(path: Path, recording: Recording) -> None:
    """Write a recording to an .npz file.

    Raises:
        ConfigError: the file cannot be written.
    """
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
    """Read what `write_recording` wrote; nothing of a stranger's file is executed.

    Raises:
        ConfigError: the file is missing, damaged, too large, or no recording.
    """
    try:
        arrays = _read_arrays(path)
    except _READ_ERRORS as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"{path}: is no readable recording ({one_line(error)[:200]}); expected"
            " <run>/diverged/<name>.npz, as a training writes it"
        ) from error
    return _checked(arrays, path)


def _read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Read the arrays of an archive, once the sizes that it promises are found small."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; expected <run>/diverged/<name>.npz")
    if path.stat().st_size > _MAX_FILE_BYTES:
        raise ConfigError(f"{path}: has more than {_MAX_FILE_BYTES // 2**20} MiB, and no recording")
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        size = sum(entry.file_size for entry in entries)
        if len(entries) > _MAX_ENTRIES or size > _MAX_FILE_BYTES:
            raise ConfigError(
                f"{path}: promises {len(entries)} arrays of {size} bytes; a recording has at most"
                f" {_MAX_ENTRIES} of {_MAX_FILE_BYTES} bytes"
            )
        return {
            entry.filename.removesuffix(".npy"): _read_array(archive.read(entry))
            for entry in entries
        }


def _read_array(content: bytes) -> npt.NDArray[Any]:
    """Return the array of an .npy file of numbers or text; memory for no more than it holds.

    Raises:
        ValueError: it is none.
    """
    stream = io.BytesIO(content)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("an entry is no array of numpy's format 1.0")
    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(stream)
    is_plain = dtype.kind in "fiuU" and dtype.itemsize > 0 and not fortran_order
    if not is_plain or min(shape, default=0) < 0:
        raise ValueError(f"an entry holds {dtype} {shape}, expected numbers or text in C order")
    return np.frombuffer(content, dtype, offset=stream.tell()).reshape(shape)


def _checked(arrays: Mapping[str, npt.NDArray[Any]], path: Path) -> Recording:
    """Return the recording in the arrays of a file.

    Raises:
        ConfigError: they are no recording.
    """
    numbers = {name: _whole_number(arrays.get(name)) for name in _NUMBERS}
    texts = {name: _text(arrays.get(name)) for name in ("format", "model_id", "task")}
    states = arrays.get("states")
    found = (texts["format"], _whole_number(arrays.get("version")))
    if found != (_FORMAT, _VERSION):
        raise ConfigError(
            f"{path}: is of the format {found}, expected {(_FORMAT, _VERSION)}: a file of"
            " <run>/diverged/"
        )
    if states is None or states.ndim != 2 or states.dtype != np.float64 or states.size == 0:
        raise ConfigError(f"{path}: has no states (control steps, numbers) of float64")
    if len(states) > _MAX_STEPS:
        raise ConfigError(f"{path}: has {len(states)} control steps, expected at most {_MAX_STEPS}")
    if None in (*numbers.values(), *texts.values()) or not (
        1 <= (numbers["substeps"] or 0) <= _MAX_SUBSTEPS
    ):
        raise ConfigError(
            f"{path}: lacks one of {', '.join((*_NUMBERS, *texts))}, or its value is out of range"
            f" (substeps 1 to {_MAX_SUBSTEPS})"
        )
    fields = {n.removeprefix(_FIELD): v for n, v in arrays.items() if n.startswith(_FIELD)}
    return Recording(
        states=states,
        substeps=int(numbers["substeps"] or 0),
        model_id=str(texts["model_id"]),
        fields=fields,
        env_id=int(numbers["env_id"] or 0),
        control_step=int(numbers["control_step"] or 0),
        task=str(texts["task"]),
    )


def _whole_number(array: npt.NDArray[Any] | None) -> int | None:
    if array is None or array.ndim > 0 or array.dtype.kind not in "iu":
        return None
    return int(array)


def _text(array: npt.NDArray[Any] | None) -> str | None:
    """Return a short text that can be printed, None for another array."""
    if array is None or array.ndim > 0 or array.dtype.kind != "U":
        return None
    text = str(array)
    return text if text.isprintable() and len(text) <= _MAX_TEXT else None
