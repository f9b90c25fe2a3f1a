"""Implements the backend Protocol by `mujoco.batch.Batch`, on the CPU.

The batch keeps float64 rows; each step converts these rows once into the preallocated float32
tensors that tasks read. Poses and velocities of the bodies, which some tasks do not need, are
computed by `utils.kinematics` when a task reads them. MuJoCo's functions would do several times the
work.
"""

from __future__ import annotations

import copy
import itertools
import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from mujoco.batch import Batch, SimulationError
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.simulation.recording import Recording, StepHistory, model_identity
from isaacgymenvs_lite.simulation.state_buffers import (
    StateBuffers,
    StateConverter,
    as_tensor,
    transpose_into,
)
from isaacgymenvs_lite.utils.kinematics import Floats
from isaacgymenvs_lite.utils.threads import thread_count

log = logging.getLogger(__name__)

_STAGE_NONE = int(mujoco.mjtStage.mjSTAGE_NONE)
_STAGE_POS = int(mujoco.mjtStage.mjSTAGE_POS)
# MuJoCo resets a simulation to its default state after one of these warnings.
_DIVERGED = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)
# A simulation counts as diverged if a joint is faster (rad/s or m/s) than this limit. PhysX limits
# bodies to 100 rad/s.
MAX_SPEED = 1000.0
# Least work of a thread. Waking a thread takes some 10 us, on a busy machine 100 us.
_WORK_PER_THREAD_S = 50e-6
_TIMED_STEPS = 5
# A batch with these flags computes positions and mass matrices only.
_NO_CONTACTS = int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
# The mass matrix depends on these fields and on the joints' axes and places, which do not change.
_MASS_FIELDS = {"body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature"}
# Largest number of recordings that are kept until somebody reads them.
_MAX_RECORDINGS = 8
# Attributes that are views of the batch's memory.
_VIEWS = (
    *("_state_rows", "_qpos_rows", "_qvel_rows", "_object_qpos", "_object_qvel"),
    *("_warmstart_rows", "_warnings", "_ctrl64", "_contacts", "_sensor_rows", "_force_rows"),
    *("_history", "_own_fields", "_positions", "_applied_rows"),
)


class CpuBatchSimulation:
    """N simulations of one model on a thread pool; see `make_simulation` for the arguments.

    Results do not depend on the number of threads.
    """

    device = torch.device("cpu")

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, substeps: int, num_threads: int = 0
    ) -> None:
        for name, value, least in (
            ("num_envs", num_envs, 1),
            ("substeps", substeps, 1),
            ("num_threads", num_threads, 0),
        ):
            if value < least:
                raise ConfigError(f"{name}={value}: expected at least {least}")
        # Without this handler MuJoCo writes MUJOCO_LOG.TXT into the working directory.
        mujoco.set_mju_user_warning(lambda message: log.debug("MuJoCo: %s", message))
        self.model = model
        self.num_envs = num_envs
        self.substeps = substeps
        self.layout = ModelLayout.from_model(model)
        self.body_names = self.layout.body_names
        self.dof_names = self.layout.dof_names
        self.object_names = self.layout.object_names
        self.num_failures = 0
        self.recordings: list[Recording] = []
        self._own_fields: dict[str, npt.NDArray[Any]] = {}
        self._positions: Batch | None = None
        self._positions_are_current = False
        batch = Batch(
            model, num_envs, num_threads or _worthwhile_threads(model, num_envs, substeps)
        )
        self._batch: Batch | None = batch
        self._allocate()
        self._bind_views(batch)
        self._refresh()

    def _bind_views(self, batch: Batch) -> None:
        self._state_rows = batch.state
        self._default_state = batch.state[0].copy()
        self._history = self._make_history(mujoco.mjtState.mjSTATE_CTRL)
        self._qpos_rows = batch.bind("qpos")
        self._qvel_rows = batch.bind("qvel")
        self._object_qpos, self._object_qvel = self._converter.of_objects(
            self._qpos_rows, self._qvel_rows
        )
        self._warmstart_rows = batch.bind("qacc_warmstart")
        self._ctrl64 = torch.from_numpy(batch.bind("ctrl"))
        self._sensor_rows = batch.bind("sensordata")
        self._force_rows: list[np.ndarray] | None = None
        self._applied_rows: np.ndarray | None = None
        # `warning` is (N, warnings, 2): the last info and the count.
        self._warnings = batch.warning[:, _DIVERGED, 1]
        layout, buffers = self.layout, self._buffers
        self._contacts: list[tuple[Floats, slice | np.ndarray, np.ndarray]] = []
        for what, columns, forces in (
            ("bodies", layout.contact_columns, buffers.contact_forces),
            ("objects", layout.object_contact_columns, buffers.object_contact_forces),
        ):
            if columns is not None:
                with_sensor = np.flatnonzero(columns[:, 0] >= 0)
                measured = columns[with_sensor]
                if (np.diff(measured.ravel()) != 1).any():
                    raise ConfigError(
                        f"the contact sensors of the model's {what} must follow one another, in"
                        " body order"
                    )
                rows = self._sensor_rows[:, measured[0, 0] : measured[-1, -1] + 1]
                bodies = slice(None) if len(measured) == len(columns) else with_sensor
                self._contacts.append((forces, bodies, rows.reshape(self.num_envs, -1, 3)))

    def _make_history(self, last: mujoco.mjtState) -> StepHistory:
        """Return a history of the states until the component `last`.

        A state begins with time, qpos, qvel, activations, initial values of the solver, controls,
        and forces on joints and bodies.
        """
        return StepHistory(self._state_rows, mujoco.mj_stateSize(self.model, 2 * int(last) - 1))

    def _allocate(self) -> None:
        self._converter = StateConverter(self.model, self.layout)
        self._buffers = StateBuffers(self.layout, self.num_envs)
        buffers = self._buffers
        self.root_states = as_tensor(buffers.root_states)
        self.dof_pos, self.dof_vel = as_tensor(buffers.dof_pos), as_tensor(buffers.dof_vel)
        self._body_pos, self._body_rot = as_tensor(buffers.body_pos), as_tensor(buffers.body_rot)
        self._body_lin_vel = as_tensor(buffers.body_lin_vel)
        self._body_ang_vel = as_tensor(buffers.body_ang_vel)
        self.contact_forces = as_tensor(buffers.contact_forces)
        self.object_states = as_tensor(buffers.object_states)
        self.object_contact_forces = as_tensor(buffers.object_contact_forces)
        self.failed = torch.zeros(self.num_envs, dtype=torch.bool)
        # Environments whose state was set after the last step have no measurements.
        self._written = np.zeros(self.num_envs, dtype=bool)
        self._speeds = [buffers.velocities]
        if self.object_names:
            self._speeds.append(buffers.object_states[7:].reshape(-1, self.num_envs))

    @property
    def dt(self) -> float:
        """Simulated time of one `step()` in s."""
        return self.model.opt.timestep * self.substeps

    @property
    def batch(self) -> Batch:
        """MuJoCo's batch of simulations, for tests and debugging; after `close` a RuntimeError.

        If a caller changes the state of the batch, the tensors are current after the next step.
        """
        if self._batch is None:
            raise RuntimeError("the simulation was closed; make a new task to go on")
        return self._batch

    @property
    def num_threads(self) -> int:
        """Worker threads in use."""
        return self.batch.nthread

    @property
    def body_pos(self) -> Tensor:
        """(N, B, 3) world positions of the body origins (m)."""
        self._require_bodies()
        return self._body_pos

    @property
    def body_rot(self) -> Tensor:
        """(N, B, 4) world rotations of the bodies, xyzw."""
        self._require_bodies()
        return self._body_rot

    @property
    def body_lin_vel(self) -> Tensor:
        """(N, B, 3) linear velocities of the body origins in world axes (m/s)."""
        self._require_body_velocities()
        return self._body_lin_vel

    @property
    def body_ang_vel(self) -> Tensor:
        """(N, B, 3) angular velocities in world axes (rad/s)."""
        self._require_body_velocities()
        return self._body_ang_vel

    @property
    def dof_forces(self) -> Tensor:
        """(N, D) torques of actuators, springs and dampers; see `SimulationBackend.dof_forces`."""
        batch = self.batch
        if self._force_rows is None:
            # After the first use of these values the batch copies them at every step.
            self._force_rows = [batch.bind("qfrc_actuator"), batch.bind("qfrc_passive")]
            if self.model.ngravcomp > 0:  # a part of qfrc_passive
                self._force_rows.append(batch.bind("qfrc_gravcomp"))
        dofs = slice(self.layout.dof_vel_adr, self.layout.num_qvel)
        actuators, passive, *compensation = (rows[:, dofs] for rows in self._force_rows)
        return self._measured(actuators + passive - sum(compensation))

    def sensor(self, *names: str) -> Tensor:
        """Return the values (N, k) of sensors; see `SimulationBackend.sensor`."""
        _ = self.batch  # raises after `close`
        columns = self.layout.sensor_columns
        for name in names:
            if name not in columns:
                raise ConfigError(unknown("sensor of the model", name, columns))
        slices = [columns[name] for name in names]
        if all(a.stop == b.start for a, b in itertools.pairwise(slices)):
            return self._measured(self._sensor_rows[:, slices[0].start : slices[-1].stop])
        return self._measured(self._sensor_rows[:, np.r_[*slices]])

    def _measured(self, rows: np.ndarray) -> Tensor:
        """Return rows (N, k) of the last physics step as a component-major tensor (N, k)."""
        columns = np.empty(rows.T.shape, dtype=np.float32)
        transpose_into(columns, rows)
        if self._written.any():
            columns[:, self._written] = 0.0
        return as_tensor(columns)

    def _require_bodies(self) -> None:
        _ = self.batch  # raises after `close`
        if not self._buffers.bodies_are_current:
            self._converter.fill_bodies(self._buffers)

    def _require_body_velocities(self) -> None:
        self._require_bodies()
        if not self._buffers.has_body_velocities:
            self._converter.fill_body_velocities(self._buffers)

    def jacobian(self, body: str, dofs: Sequence[str]) -> Tensor:
        """Return the Jacobian (N, 6, k) of a body; see `SimulationBackend.jacobian`."""
        place = 1 + _index(self.body_names, body, "body")
        columns = self._dof_columns(dofs)
        batch = self._current_positions()
        # MuJoCo's motion axes belong to the centre of mass of the tree.
        centre = batch.bind("subtree_com")[:, self.model.body_rootid[place]]
        lever = torch.from_numpy(batch.bind("xpos")[:, place] - centre).float()
        axes = torch.from_numpy(batch.bind("cdof")[:, columns].astype(np.float32))
        axes *= torch.from_numpy(_moves(self.model, place)[columns, None])
        angular, linear = axes.split(3, dim=-1)
        linear = linear + torch.linalg.cross(angular, lever[:, None].expand_as(angular))
        return torch.cat((linear, angular), dim=-1).transpose(1, 2)

    def mass_matrix(self, dofs: Sequence[str]) -> Tensor:
        """Return a part (N, k, k) of the mass matrix; see `SimulationBackend.mass_matrix`."""
        columns = self._dof_columns(dofs)
        matrices = self._current_positions().bind("M")
        places = self._mass_places[np.ix_(columns, columns)]
        return torch.from_numpy((matrices[:, places] * (places >= 0)).astype(np.float32))

    def _current_positions(self) -> Batch:
        """Return a batch that has computed positions and mass matrices of the current state.

        It has no contacts, which are most of the work. The batch is made at the first use.
        """
        _ = self.batch  # raises after `close`
        batch = self._positions
        if batch is None:
            model = copy.copy(self.model)
            model.opt.disableflags |= _NO_CONTACTS
            self._positions = batch = Batch(model, self.num_envs, self.num_threads)
            self._mass_places = _mass_places(model)
            for field in ("M", "cdof", "xpos", "subtree_com"):
                batch.bind(field)
        if not self._positions_are_current:
            batch.bind("qpos")[:] = self._qpos_rows
            for field in _MASS_FIELDS.intersection(self._own_fields):
                batch.expand(field)[:] = self._own_fields[field]
            batch.forward(stage=_STAGE_POS)
            self._positions_are_current = True
        return batch

    def _dof_columns(self, dofs: Sequence[str]) -> np.ndarray:
        """Return the columns of qvel of named degrees of freedom."""
        places = [_index(self.dof_names, dof, "degree of freedom") for dof in dofs]
        return self.layout.dof_vel_adr + np.array(places)

    def apply_forces(self, bodies: Sequence[str], forces: Tensor) -> None:
        """Apply forces (N, k, 3) during the next step; see `SimulationBackend.apply_forces`."""
        batch = self.batch
        rows = self._applied_rows
        if rows is None:
            self._applied_rows = rows = batch.bind("xfrc_applied")
            self._history = self._make_history(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
        names = (*self.body_names, *self.object_names)
        places = [1 + _index(names, body, "body") for body in bodies]
        rows[:, places, :3] = forces.numpy()

    def expand(self, field: str) -> npt.NDArray[Any]:
        """Return a field's values for each environment; see `SimulationBackend.expand`."""
        values = self.batch.expand(field)
        self._own_fields[field] = values
        self._positions_are_current = False
        return values

    def update_constants(self, env_ids: npt.NDArray[np.integer]) -> None:
        """See `SimulationBackend.update_constants`."""
        self.batch.set_const(env_ids)
        self._positions_are_current = False

    def set_controls(self, controls: Tensor) -> None:
        """Set the actuators' controls, (N, U), for the next steps."""
        _ = self.batch  # raises after `close`
        self._ctrl64.copy_(controls)

    def step(self) -> None:
        """Advance all simulations by `substeps` physics steps and refresh the state tensors."""
        batch = self.batch
        self._history.add()
        try:
            batch.step(nstep=self.substeps)
            raised = None
        except SimulationError as error:
            log.debug("%s", error)
            raised = error.ids
        if self._applied_rows is not None:
            self._applied_rows[:] = 0.0
        self._written[:] = self._positions_are_current = False
        self._refresh()
        self._recover(batch, raised)

    def _recover(self, batch: Batch, raised: np.ndarray | None) -> None:
        """Reset diverged simulations to the default state; set their flags and count them."""
        diverged = np.zeros(self.num_envs, dtype=bool)
        for speeds in self._speeds:
            # The test of each environment is slow, so it runs only if a value is too large or NaN.
            if not -MAX_SPEED <= speeds.min() <= speeds.max() <= MAX_SPEED:
                diverged |= (np.abs(speeds) > MAX_SPEED).any(axis=0)
        if raised is not None:
            diverged[raised] = True
        if self._warnings.any():
            diverged |= self._warnings.any(axis=1)
        self.failed.copy_(torch.from_numpy(diverged))
        rows = diverged.nonzero()[0]
        if len(rows) == 0:
            return
        self.num_failures += len(rows)
        self._record(rows)
        batch.reset(rows, stage=_STAGE_NONE)
        self._warnings[rows] = 0
        self._written[rows] = True
        self._positions_are_current = False
        self._history.restart(rows)
        self._refresh_rows(rows, self._qpos_rows[rows], self._qvel_rows[rows])

    def _record(self, rows: np.ndarray) -> None:
        """Keep the last steps of the first few diverged simulations (n,)."""
        room = _MAX_RECORDINGS - len(self.recordings)
        model_id = model_identity(self.model) if room > 0 else ""
        for row in rows[:room].tolist():
            states = self._history.states(row)
            fields = {name: values[row].copy() for name, values in self._own_fields.items()}
            step = self._history.added - len(states)
            self.recordings.append(Recording(states, self.substeps, model_id, fields, row, step))

    def write_state(
        self, env_ids: Tensor, root_states: Tensor, dof_pos: Tensor, dof_vel: Tensor
    ) -> None:
        """Set n environments to a new state; see `SimulationBackend.write_state`."""
        _ = self.batch  # raises after `close`
        rows = env_ids.numpy()
        if len(rows) == 0:
            return
        qpos, qvel = self._converter.rows(root_states, dof_pos, dof_vel)
        # The next step starts from this row; writing the row is faster than Batch.reset.
        self._state_rows[rows] = self._default_state
        self._qpos_rows[rows] = qpos
        self._qvel_rows[rows] = qvel
        self._written[rows] = True
        self._positions_are_current = False
        self._history.restart(rows)
        self._refresh_rows(rows, qpos, qvel)

    def write_object_states(self, env_ids: Tensor, object_ids: Tensor, states: Tensor) -> None:
        """Set k objects of n environments; see `SimulationBackend.write_object_states`."""
        _ = self.batch  # raises after `close`
        if len(env_ids) == 0 or len(object_ids) == 0:
            return
        rows, objects = env_ids.numpy(), object_ids.numpy()
        qpos, qvel = self._converter.object_rows(states)
        places = np.ix_(rows, objects)
        self._object_qpos[places], self._object_qvel[places] = qpos, qvel
        self._warmstart_rows[rows] = 0.0
        self._buffers.replace_objects(rows, objects, self._converter.states_of_objects(qpos, qvel))

    def state_dict(self) -> dict[str, Any]:
        """See `SimulationBackend.state_dict`."""
        memory = {name: torch.from_numpy(rows.copy()) for name, rows in self._memory().items()}
        bodies = [self._buffers.bodies_are_current, self._buffers.has_body_velocities]
        return {**memory, "num_failures": self.num_failures, "bodies": bodies}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `SimulationBackend.load_state_dict`."""
        if "forces.0" in state:
            _ = self.dof_forces  # allocates the rows
        memory = self._memory()
        for name, rows in memory.items():
            stored = state[name].numpy()
            if stored.shape != rows.shape or stored.dtype != rows.dtype:
                raise ValueError(f"{name} of the simulation: {stored.shape}, expected {rows.shape}")
        for name, rows in memory.items():
            measured = not rows.flags.writeable  # the batch writes these rows at every step
            if measured:
                rows.flags.writeable = True
            rows[...] = state[name].numpy()
            if measured:
                rows.flags.writeable = False
        self.num_failures = int(state["num_failures"])
        self._positions_are_current = False
        self._buffers.bodies_are_current, self._buffers.has_body_velocities = map(
            bool, state["bodies"]
        )
        if self._own_fields:
            self.batch.set_const(np.arange(self.num_envs))

    def _memory(self) -> dict[str, np.ndarray]:
        """Return the arrays on which later steps depend or which are read before the next step."""
        return {
            "state": self.batch.state,
            "sensordata": self._sensor_rows,
            "written": self._written,
            "failed": self.failed.numpy(),
            **self._buffers.memory,
            **{f"forces.{i}": rows for i, rows in enumerate(self._force_rows or ())},
            **{f"model.{field}": values for field, values in self._own_fields.items()},
        }

    def _refresh(self) -> None:
        """Convert the batch's rows of all environments into the state tensors."""
        self._converter.fill(self._buffers, self._qpos_rows, self._qvel_rows)
        for forces, bodies, rows in self._contacts:
            # The sensor measures the force that the body exerts; tasks need the force on the body.
            if isinstance(bodies, slice):
                transpose_into(forces, rows)
                np.negative(forces, out=forces)
            else:
                forces[:, bodies] = -rows.T

    def _refresh_rows(self, rows: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Convert qpos and qvel of n environments whose state was set, without contact forces."""
        buffers = StateBuffers(self.layout, len(rows))
        self._converter.fill(buffers, qpos, qvel)
        if self._buffers.bodies_are_current:
            self._converter.fill_bodies(buffers)
        if self._buffers.has_body_velocities:
            self._converter.fill_body_velocities(buffers)
        self._buffers.replace(rows, buffers)

    def close(self) -> None:
        """Release the simulations and their threads; a second call does nothing."""
        self._batch = None
        # As long as these views exist, the batch's memory and threads exist.
        for view in _VIEWS:
            self.__dict__.pop(view, None)


def _index(names: Sequence[str], name: str, what: str) -> int:
    if name not in names:
        raise ConfigError(unknown(f"{what} of the model", name, names))
    return names.index(name)


def _moves(model: mujoco.MjModel, body: int) -> npt.NDArray[np.bool_]:
    """Return which degrees of freedom (nv,) move a body."""
    ancestors = set()
    while body > 0:
        ancestors.add(body)
        body = int(model.body_parentid[body])
    return np.isin(model.dof_bodyid, list(ancestors))


def _mass_places(model: mujoco.MjModel) -> npt.NDArray[np.intp]:
    """Return the index (nv, nv) of each entry of the mass matrix in MuJoCo's `M`, -1 for zeros."""
    places = np.full((model.nv, model.nv), -1)
    for row, (first, size) in enumerate(zip(model.M_rowadr, model.M_rownnz, strict=True)):
        columns = model.M_colind[first : first + size]
        places[row, columns] = places[columns, row] = np.arange(first, first + size)
    return places


def _worthwhile_threads(model: mujoco.MjModel, num_envs: int, substeps: int) -> int:
    """Return the number of threads that have enough work in a control step.

    The work is estimated from the shortest of a few timed physics steps, because other programs on
    the machine make steps longer.
    """
    cpus = min(thread_count(), num_envs)
    if cpus == 1:
        return 1
    data = mujoco.MjData(model)
    times_s = []
    for _ in range(_TIMED_STEPS):
        start_s = time.perf_counter()
        mujoco.mj_step(model, data)
        times_s.append(time.perf_counter() - start_s)
    work_s = min(times_s) * substeps * num_envs
    return max(1, min(cpus, int(work_s / _WORK_PER_THREAD_S)))
