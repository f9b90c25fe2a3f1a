"""Physics on the CPU: `mujoco.batch.Batch` behind the backend Protocol.

The batch keeps float64 rows; each step converts what tasks read into preallocated float32 tensors
once. Conversions that only some tasks need (body rotations and velocities) happen on first use
after a step.
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
from isaacgymenvs_lite.utils.rotations import (
    cross,
    quat_log,
    quat_rotate,
    quat_rotate_inverse,
    xyzw_from_wxyz,
)
from isaacgymenvs_lite.utils.threads import thread_count

log = logging.getLogger(__name__)

_STAGE_NONE = int(mujoco.mjtStage.mjSTAGE_NONE)
_STAGE_POS = int(mujoco.mjtStage.mjSTAGE_POS)
_STAGE_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)
# MuJoCo puts a simulation with one of these warnings back to its default state by itself.
_DIVERGED = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
# A joint faster than this (rad/s or m/s) is no motion but a simulation on its way to infinity;
# PhysX stopped such bodies at 100 rad/s.
_MAX_SPEED = 1000.0
# Attributes that look into the batch's own memory.
_VIEWS = (
    "_qpos_rows",
    "_qvel_rows",
    "_warnings",
    "_qpos64",
    "_qvel64",
    "_ctrl64",
    "_xpos64",
    "_contact64",
)


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
        batch.forward(stage=self._stage)
        self._refresh()

    def _bind_views(self, batch: Batch) -> None:
        self._qpos_rows = batch.bind("qpos")
        self._qvel_rows = batch.bind("qvel")
        # (N, warnings, [last info, count]) -> counts
        self._warnings = batch.warning[..., 1]
        self._qpos64 = torch.from_numpy(self._qpos_rows)
        self._qvel64 = torch.from_numpy(self._qvel_rows)
        self._ctrl64 = torch.from_numpy(batch.bind("ctrl"))
        self._xpos64 = _read_only_tensor(batch.bind("xpos"))[:, 1:]
        columns = self.layout.contact_columns
        self._contact64 = None
        if columns is not None:
            sensordata = _read_only_tensor(batch.bind("sensordata"))
            first, last = int(columns.min()), int(columns.max()) + 1
            if last - first != columns.size or (np.diff(columns.ravel()) != 1).any():
                raise ConfigError("the model's contact sensors must stand together, in body order")
            self._contact64 = sensordata[:, first:last].view(self.num_envs, -1, 3)

    def _allocate(self) -> None:
        layout, n, num_bodies = self.layout, self.num_envs, len(self.body_names)
        self._qpos = torch.empty(self._qpos64.shape)
        self._qvel = torch.empty(self._qvel64.shape)
        self.root_states = torch.zeros(n, 13)
        self.dof_pos = torch.zeros(n, layout.num_dofs)
        self.dof_vel = self._qvel[:, layout.dof_vel_adr :]
        self.body_pos = torch.zeros(n, num_bodies, 3)
        self.contact_forces = torch.zeros(n, num_bodies, 3)
        self.failed = torch.zeros(n, dtype=torch.bool)
        self._ball_qpos = torch.from_numpy(layout.ball_qpos)
        self._ball_dofs = torch.from_numpy(layout.ball_dofs)
        self._scalar_qpos = torch.from_numpy(layout.scalar_qpos)
        self._scalar_dofs = torch.from_numpy(layout.scalar_dofs)
        self._on_demand: dict[str, Tensor] = {}
        # Body velocities need one stage more; it is computed from the first time they are read.
        self._stage = _STAGE_POS
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
    def body_rot(self) -> Tensor:
        """(N, B, 4) world rotations, xyzw."""
        return self._demand("body_rot", self._compute_body_rot)

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
        diverged = self._qvel.abs().amax(dim=1) > _MAX_SPEED
        if raised is not None:
            diverged[torch.from_numpy(np.asarray(raised, dtype=np.int64))] = True
        if self._warnings[:, _DIVERGED].any():
            diverged |= torch.from_numpy(self._warnings[:, _DIVERGED].any(axis=1))
        self.failed.copy_(diverged)
        ids = diverged.nonzero().flatten()
        if len(ids) == 0:
            return
        self.num_failures += len(ids)
        rows = ids.numpy()
        batch.reset(rows, stage=self._stage)
        self._warnings[rows] = 0
        self._refresh_rows(ids)

    def write_state(
        self, env_ids: Tensor, root_states: Tensor, dof_pos: Tensor, dof_vel: Tensor
    ) -> None:
        """Put n environments into a new state; see `SimulationBackend.write_state`."""
        batch = self._require_batch()
        if len(env_ids) == 0:
            return
        # The batch takes ids in ascending order.
        env_ids, order = env_ids.sort()
        root_states, dof_pos, dof_vel = root_states[order], dof_pos[order], dof_vel[order]
        rows = env_ids.numpy()
        batch.reset(rows, stage=_STAGE_NONE)
        qpos, qvel = self._rows_from_isaac(root_states, dof_pos, dof_vel)
        self._qpos_rows[rows] = qpos
        self._qvel_rows[rows] = qvel
        batch.forward(rows, stage=self._stage)
        self._refresh_rows(env_ids)

    def _rows_from_isaac(
        self, root_states: Tensor, dof_pos: Tensor, dof_vel: Tensor
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return qpos (n, nq) and qvel (n, nv) in MuJoCo's conventions, float64."""
        n = len(dof_pos)
        dof_pos64 = dof_pos.double()
        qpos = torch.zeros(n, self.model.nq, dtype=torch.float64)
        qvel = torch.zeros(n, self.model.nv, dtype=torch.float64)
        if self.layout.has_free_root:
            root = root_states.double()
            rotation = root[:, 3:7]
            qpos[:, :3] = root[:, :3]
            qpos[:, 3] = rotation[:, 3]
            qpos[:, 4:7] = rotation[:, :3]
            qvel[:, :3] = root[:, 7:10]
            # MuJoCo keeps the angular velocity of a free joint in the body's own frame.
            qvel[:, 3:6] = quat_rotate_inverse(rotation, root[:, 10:13])
        qpos[:, self._scalar_qpos] = dof_pos64[:, self._scalar_dofs]
        vectors = dof_pos64[:, self._ball_dofs]
        half = vectors.norm(dim=-1, keepdim=True) * 0.5
        # sin(x)/x through sinc: exact at zero, where a joint spends its default pose
        qpos[:, self._ball_qpos] = torch.cat(
            (vectors * (0.5 * torch.sinc(half / torch.pi)), half.cos()), dim=-1
        )
        qvel[:, self.layout.dof_vel_adr :] = dof_vel
        return qpos.numpy(), qvel.numpy()

    def _refresh(self) -> None:
        """Convert the batch's rows of all environments into the state tensors."""
        self._on_demand.clear()
        self._qpos.copy_(self._qpos64)
        self._qvel.copy_(self._qvel64)
        self.body_pos.copy_(self._xpos64)
        if self._contact64 is not None:
            # The sensor reports the force that the body exerts; tasks want the force on it.
            torch.neg(self._contact64.float(), out=self.contact_forces)
        self._convert(self._qpos, self._qvel, self.root_states, self.dof_pos)

    def _refresh_rows(self, ids: Tensor) -> None:
        """The same for environments that were written: they have no contact forces yet."""
        self._on_demand.clear()
        qpos, qvel = self._qpos64[ids].float(), self._qvel64[ids].float()
        root_states = torch.zeros(len(ids), 13)
        dof_pos = torch.empty(len(ids), self.layout.num_dofs)
        self._convert(qpos, qvel, root_states, dof_pos)
        self._qpos[ids] = qpos
        self._qvel[ids] = qvel
        self.root_states[ids] = root_states
        self.dof_pos[ids] = dof_pos
        self.body_pos[ids] = self._xpos64[ids].float()
        self.contact_forces[ids] = 0.0

    # index_select and index_copy_ are several times as fast as indexing with a tensor.
    def _convert(self, qpos: Tensor, qvel: Tensor, root_states: Tensor, dof_pos: Tensor) -> None:
        """Fill root states and DOF positions from MuJoCo's coordinates (rows of float32)."""
        if self.layout.has_free_root:
            root_states[:, :3] = qpos[:, :3]
            root_states[:, 3:6] = qpos[:, 4:7]
            root_states[:, 6] = qpos[:, 3]
            root_states[:, 7:10] = qvel[:, :3]
            root_states[:, 10:13] = quat_rotate(root_states[:, 3:7], qvel[:, 3:6])
        if len(self._scalar_dofs):
            dof_pos.index_copy_(1, self._scalar_dofs, qpos.index_select(1, self._scalar_qpos))
        if len(self._ball_dofs):
            balls = qpos.index_select(1, self._ball_qpos.flatten())
            vectors = quat_log(balls.view(len(qpos), -1, 4))
            dof_pos.index_copy_(1, self._ball_dofs.flatten(), vectors.flatten(1))

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

    def _compute_body_rot(self) -> Tensor:
        return xyzw_from_wxyz(self._derived("xquat"))

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
