"""Physics on the CPU: `mujoco.batch.Batch` behind the backend Protocol.

The batch keeps float64 rows; each step converts what tasks read into preallocated float32 tensors
once. Body velocities, which only some tasks need, are converted on first use after a step.

The batch is not asked where the bodies are: after a step that would take its whole stage of
positions, several times the work of our own forward kinematics.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.simulation.state_planes import (
    StateConverter,
    StatePlanes,
    tensor_of_planes,
)
from isaacgymenvs_lite.utils.rotations import cross
from isaacgymenvs_lite.utils.threads import thread_count

log = logging.getLogger(__name__)

_STAGE_NONE = int(mujoco.mjtStage.mjSTAGE_NONE)
_STAGE_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)
# MuJoCo puts a simulation with one of these warnings back to its default state by itself.
_DIVERGED = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)
# A joint faster than this (rad/s or m/s) is no motion but a simulation on its way to infinity;
# PhysX stopped such bodies at 100 rad/s.
_MAX_SPEED = 1000.0
# Attributes that look into the batch's own memory.
_VIEWS = ("_state_rows", "_qpos_rows", "_qvel_rows", "_warnings", "_ctrl64", "_contact_rows")


class CpuBatchSimulation:
    """N simulations of one model on a thread pool; meets `SimulationBackend`.

    Args:
        model: the compiled model; its timestep is that of one physics step.
        num_envs: N, at least 1.
        substeps: physics steps of one `step()`.
        num_threads: worker threads, 0 for all CPUs that this process may use. Results do not
            depend on it.

    Raises:
        ConfigError: a number out of range.
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
        _silence_mujoco_log_file()
        self.model = model
        self.num_envs = num_envs
        self.substeps = substeps
        self.layout = ModelLayout.from_model(model)
        self.body_names = self.layout.body_names
        self.dof_names = self.layout.dof_names
        self.num_failures = 0
        batch = Batch(model, num_envs, thread_count(num_threads))
        self._batch: Batch | None = batch
        self._bind_views(batch)
        self._allocate()
        self._refresh()

    def _bind_views(self, batch: Batch) -> None:
        self._state_rows = batch.state
        self._default_state = batch.state[0].copy()
        self._qpos_rows = batch.bind("qpos")
        self._qvel_rows = batch.bind("qvel")
        self._ctrl64 = torch.from_numpy(batch.bind("ctrl"))
        # (N, warnings, [last info, count]) -> counts
        self._warnings = batch.warning[:, _DIVERGED, 1]
        columns = self.layout.contact_columns
        self._contact_rows = None
        if columns is not None:
            first, last = int(columns.min()), int(columns.max()) + 1
            if last - first != columns.size or (np.diff(columns.ravel()) != 1).any():
                raise ConfigError("the model's contact sensors must stand together, in body order")
            rows = batch.bind("sensordata")[:, first:last]
            self._contact_rows = rows.reshape(self.num_envs, -1, 3)

    def _allocate(self) -> None:
        self._converter = StateConverter(self.model, self.layout)
        self._planes = StatePlanes(self.layout, self.num_envs)
        self.root_states = tensor_of_planes(self._planes.root_states)
        self.dof_pos = tensor_of_planes(self._planes.dof_pos)
        self.dof_vel = tensor_of_planes(self._planes.dof_vel)
        self.body_pos = tensor_of_planes(self._planes.body_pos)
        self.body_rot = tensor_of_planes(self._planes.body_rot)
        self.contact_forces = tensor_of_planes(self._planes.contact_forces)
        self.failed = torch.zeros(self.num_envs, dtype=torch.bool)
        self._on_demand: dict[str, Tensor] = {}
        # Body velocities are MuJoCo's; its stage is computed from the first time they are read.
        self._stage = _STAGE_NONE
        self._derived_in_use: set[str] = set()
        self._tree_roots = torch.from_numpy(self.model.body_rootid[1:].astype(np.int64)) - 1

    @property
    def dt(self) -> float:
        """Simulated time of one `step()` in s."""
        return self.model.opt.timestep * self.substeps

    @property
    def num_threads(self) -> int:
        """Worker threads in use."""
        return self._require_batch().nthread

    @property
    def body_lin_vel(self) -> Tensor:
        """(N, B, 3) linear velocities of the body origins in world axes (m/s)."""
        return self._demand("body_lin_vel", self._compute_body_lin_vel)

    @property
    def body_ang_vel(self) -> Tensor:
        """(N, B, 3) angular velocities in world axes (rad/s)."""
        return self._demand("body_ang_vel", lambda: self._derived("cvel")[..., :3])

    def set_controls(self, controls: Tensor) -> None:
        """Set the actuators' controls, (N, U), for the next steps."""
        self._require_batch()
        self._ctrl64.copy_(controls)

    def step(self) -> None:
        """Advance all simulations by `substeps` physics steps and refresh the state tensors."""
        batch = self._require_batch()
        try:
            batch.step(nstep=self.substeps, stage=self._stage)
            raised = None
        except SimulationError as error:
            log.debug("%s", error)
            raised = error.ids
        self._refresh()
        self._recover(batch, raised)

    def _recover(self, batch: Batch, raised: np.ndarray | None) -> None:
        """Put diverged simulations back to the default state, flag and count them."""
        diverged = np.zeros(self.num_envs, dtype=bool)
        velocities = self._planes.velocities
        # Asking each environment is slow: only if some number is too large, or none.
        if not -_MAX_SPEED <= velocities.min() <= velocities.max() <= _MAX_SPEED:
            diverged |= (np.abs(velocities) > _MAX_SPEED).any(axis=0)
        if raised is not None:
            diverged[raised] = True
        if self._warnings.any():
            diverged |= self._warnings.any(axis=1)
        self.failed.copy_(torch.from_numpy(diverged))
        rows = diverged.nonzero()[0]
        if len(rows) == 0:
            return
        self.num_failures += len(rows)
        batch.reset(rows, stage=self._stage)
        self._warnings[rows] = 0
        self._refresh_rows(rows, self._qpos_rows[rows], self._qvel_rows[rows])

    def write_state(
        self, env_ids: Tensor, root_states: Tensor, dof_pos: Tensor, dof_vel: Tensor
    ) -> None:
        """Put n environments into a new state; see `SimulationBackend.write_state`."""
        batch = self._require_batch()
        rows = env_ids.numpy()
        if len(rows) == 0:
            return
        qpos, qvel = self._converter.rows(root_states, dof_pos, dof_vel)
        if (rows[1:] <= rows[:-1]).any():
            # The batch takes ids in ascending order.
            order = rows.argsort()
            rows, qpos, qvel = rows[order], qpos[order], qvel[order]
        # What Batch.reset does, without its work per simulation: the next step starts from the row.
        self._state_rows[rows] = self._default_state
        self._qpos_rows[rows] = qpos
        self._qvel_rows[rows] = qvel
        if self._stage != _STAGE_NONE:
            batch.forward(rows, stage=self._stage)
        self._refresh_rows(rows, qpos, qvel)

    def _refresh(self) -> None:
        """Convert the batch's rows of all environments into the state tensors."""
        self._on_demand.clear()
        self._converter.fill(self._planes, self._qpos_rows, self._qvel_rows)
        if self._contact_rows is not None:
            # The sensor reports the force that the body exerts; tasks want the force on it.
            forces = self._planes.contact_forces
            forces[:] = self._contact_rows.T
            np.negative(forces, out=forces)

    def _refresh_rows(self, rows: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """The same for environments (n,) that were written: they have no contact forces yet."""
        self._on_demand.clear()
        planes = StatePlanes(self.layout, len(rows))
        self._converter.fill(planes, qpos, qvel)
        self._planes.replace(rows, planes)

    def _demand(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        self._require_batch()
        if name not in self._on_demand:
            self._on_demand[name] = compute()
        return self._on_demand[name]

    def _derived(self, field: str) -> Tensor:
        """A body field of MuJoCo, (N, B, ...) float32, without the world."""
        batch = self._require_batch()
        rows = batch.bind(field)
        if field not in self._derived_in_use:
            self._derived_in_use.add(field)
            self._stage = _STAGE_VEL
            # A field bound between calls is zero until the next call.
            batch.forward(stage=self._stage)
        return _read_only_tensor(rows)[:, 1:].float()

    def _compute_body_lin_vel(self) -> Tensor:
        # cvel is the velocity of the point of the body that passes through the centre of mass of
        # the body's tree; shift it to the body's origin.
        cvel = self._derived("cvel")
        centre = self._derived("subtree_com")[:, self._tree_roots]
        return cvel[..., 3:] + cross(cvel[..., :3], self.body_pos - centre)

    def _require_batch(self) -> Batch:
        if self._batch is None:
            raise RuntimeError("the simulation was closed; make a new task to go on")
        return self._batch

    def close(self) -> None:
        """Free the simulations and their threads; a second call does nothing."""
        self._batch = None
        self._on_demand.clear()
        # The views keep the batch's memory, and with it its threads, alive.
        for view in _VIEWS:
            self.__dict__.pop(view, None)


def _read_only_tensor(rows: np.ndarray) -> Tensor:
    """A tensor over a read-only output of the batch; torch has no read-only tensors."""
    view = rows.view()
    view.flags.writeable = True
    return torch.from_numpy(view)


def _silence_mujoco_log_file() -> None:
    """Send MuJoCo's warnings to our log instead of MUJOCO_LOG.TXT in the working directory."""
    mujoco.set_mju_user_warning(lambda message: log.debug("MuJoCo: %s", message))
