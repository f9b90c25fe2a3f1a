"""Converts between the float32 state that tasks read and MuJoCo's qpos and qvel.

The state is stored component-major: each component has a contiguous row with a value for each
environment. Reductions and rotations over components then read contiguous memory, in a fraction of
the time.

A free body (the robot's root or an object) has a state of 13 values: position, rotation xyzw,
linear and angular velocity in world axes. In MuJoCo quaternions are wxyz and not normalised, and
the angular velocity of a free joint is in the body's frame.
"""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.utils.kinematics import MIN_LENGTH, Floats, Kinematics, unit_quats
from isaacgymenvs_lite.utils.rotations import quat_log, rotate_components, xyzw_from_wxyz

Doubles = npt.NDArray[np.float64]

STATE_SIZE = 13
QPOS_SIZE = 7
QVEL_SIZE = 6
_ROWS_IN_CACHE = 256
# The indices of position and rotation xyzw in the qpos of a free joint.
_QPOS_ROWS = np.append(np.arange(3), xyzw_from_wxyz(torch.arange(3, 7)).numpy())


class StateBuffers:
    """The float32 state of n environments with B bodies, D degrees of freedom and K objects.

    All values are zero at first. `SimulationBackend` has the same names and units, but there the
    environments are the first dimension.

    Attributes:
        root_states: (13, n).
        dof_pos: (D, n).
        dof_vel: (D, n).
        velocities: (6 + D, n) velocities of the root, followed by `dof_vel`.
        qpos: (Q, n) the robot's values in MuJoCo's qpos.
        body_pos: (3, B, n).
        body_rot: (4, B, n).
        contact_forces: (3, B, n).
        object_states: (13, K, n).
        object_contact_forces: (3, K, n).
        body_lin_vel: (3, B, n).
        body_ang_vel: (3, B, n).
        bodies_are_current: whether `body_pos` and `body_rot` belong to `qpos`; see `fill_bodies`.
        has_body_velocities: whether the body velocities are current; see `fill_body_velocities`.
    """

    def __init__(self, layout: ModelLayout, num_envs: int) -> None:
        num_dofs, num_bodies = layout.num_dofs, len(layout.body_names)
        num_objects = len(layout.object_names)
        first_dof_pos = STATE_SIZE + num_dofs
        first_qpos = first_dof_pos + num_dofs
        first_body = first_qpos + layout.num_qpos
        first_object = first_body + 10 * num_bodies
        num_rows = first_object + (STATE_SIZE + 3) * num_objects
        # All values share one block of memory, so that one operation can replace them.
        self._all = np.zeros((num_rows, num_envs), dtype=np.float32)
        self.root_states = self._all[:STATE_SIZE]
        self.dof_vel = self._all[STATE_SIZE:first_dof_pos]
        self.velocities = self._all[7:first_dof_pos]
        self.dof_pos = self._all[first_dof_pos:first_qpos]
        self.qpos = self._all[first_qpos:first_body]
        bodies = self._all[first_body:first_object].reshape(10, num_bodies, num_envs)
        self.body_pos, self.body_rot, self.contact_forces = bodies[:3], bodies[3:7], bodies[7:]
        objects = self._all[first_object:].reshape(STATE_SIZE + 3, num_objects, num_envs)
        self.object_states, self.object_contact_forces = objects[:STATE_SIZE], objects[STATE_SIZE:]
        self._body_velocities = np.zeros((6, num_bodies, num_envs), dtype=np.float32)
        self.body_lin_vel, self.body_ang_vel = self._body_velocities[:3], self._body_velocities[3:]
        self.bodies_are_current = False
        self.has_body_velocities = False

    @property
    def memory(self) -> dict[str, Floats]:
        """Maps names to the blocks of memory that contain all values."""
        return {"tensors": self._all, "body_velocities": self._body_velocities}

    def replace(self, env_ids: npt.NDArray[np.integer], others: StateBuffers) -> None:
        """Copy the n environments of `others` to the environments `env_ids` (n,).

        If the bodies and velocities of `self` are current, those of `others` must also be current.
        """
        _replace_columns(self._all, env_ids, others._all)
        if self.has_body_velocities:
            _replace_columns(self._body_velocities, env_ids, others._body_velocities)

    def replace_objects(
        self,
        env_ids: npt.NDArray[np.integer],
        object_ids: npt.NDArray[np.integer],
        states: Floats,
    ) -> None:
        """Set k objects of n environments to `states` (13, k, n), without contact forces."""
        places = object_ids[:, None], env_ids
        self.object_states[:, *places] = states
        self.object_contact_forces[:, *places] = 0.0


def _replace_columns(mine: Floats, columns: npt.NDArray[np.integer], theirs: Floats) -> None:
    # Indexing in torch is several times as fast as in numpy.
    ids = torch.from_numpy(columns)
    torch.from_numpy(mine).index_copy_(mine.ndim - 1, ids, torch.from_numpy(theirs))


def transpose_into(columns: Floats, rows: Doubles) -> None:
    """Copy rows (n, ...) into columns (..., n), in blocks of rows that fit into the cache."""
    for first in range(0, len(rows), _ROWS_IN_CACHE):
        block = slice(first, first + _ROWS_IN_CACHE)
        columns[..., block] = rows[block].T


def as_tensor(buffer: Floats) -> Tensor:
    """Return a buffer (d, n) or (d, B, n) as a tensor (n, d) or (n, B, d) on the same memory."""
    return torch.from_numpy(buffer.T)


class StateConverter:
    """Converts rows of qpos and qvel into state buffers, and states into rows."""

    def __init__(self, model: mujoco.MjModel, layout: ModelLayout) -> None:
        self._layout = layout
        self._kinematics = Kinematics(model, len(layout.body_names))
        self._num_qpos = layout.num_qpos
        self._num_qvel = layout.num_qvel
        # Only a free root has velocities in qvel.
        self._first_velocity = QVEL_SIZE - layout.dof_vel_adr
        self._ball_qpos = layout.ball_qpos.T
        self._ball_dofs = layout.ball_dofs.T
        self._objects_qpos0 = model.qpos0[layout.num_qpos :].copy()

    @np.errstate(all="ignore")  # a simulation may be diverging
    def fill(self, buffers: StateBuffers, qpos_rows: Doubles, qvel_rows: Doubles) -> None:
        """Fill the buffers, except contact forces and bodies, from rows (n, nq) and (n, nv)."""
        layout = self._layout
        buffers.bodies_are_current = buffers.has_body_velocities = False
        qpos = buffers.qpos
        transpose_into(qpos, qpos_rows[:, : self._num_qpos])
        transpose_into(buffers.velocities[self._first_velocity :], qvel_rows[:, : self._num_qvel])
        if layout.has_free_root:
            fill_free_states(buffers.root_states, qpos[:7], buffers.root_states[7:])
        buffers.dof_pos[layout.scalar_dofs] = qpos[layout.scalar_qpos]
        if self._ball_qpos.size > 0:
            quats = torch.from_numpy(qpos[self._ball_qpos]).permute(2, 1, 0)
            buffers.dof_pos[self._ball_dofs] = quat_log(quats).permute(2, 1, 0).numpy()
        if layout.object_names:
            buffers.object_states[:] = self.states_of_objects(
                *self.of_objects(qpos_rows, qvel_rows)
            )

    @np.errstate(all="ignore")
    def fill_bodies(self, buffers: StateBuffers) -> None:
        """Compute the poses of the bodies, after `fill`."""
        buffers.bodies_are_current = True
        self._kinematics.poses(buffers.qpos, buffers.body_pos, buffers.body_rot)

    @np.errstate(all="ignore")
    def fill_body_velocities(self, buffers: StateBuffers) -> None:
        """Compute the velocities of the bodies, after `fill_bodies`."""
        buffers.has_body_velocities = True
        qvel = buffers.velocities[self._first_velocity :]
        poses = buffers.body_pos, buffers.body_rot
        velocities = buffers.body_lin_vel, buffers.body_ang_vel
        self._kinematics.velocities(buffers.qpos, qvel, *poses, *velocities)

    def of_objects(self, qpos_rows: Doubles, qvel_rows: Doubles) -> tuple[Doubles, Doubles]:
        """Return the values (n, K, 7) and (n, K, 6) of objects in qpos (n, nq) and qvel (n, nv).

        The results share memory with the arguments.
        """
        layout = self._layout
        shape = (len(qpos_rows), len(layout.object_names))
        return (
            qpos_rows[:, layout.num_qpos :].reshape(*shape, QPOS_SIZE),
            qvel_rows[:, layout.num_qvel :].reshape(*shape, QVEL_SIZE),
        )

    @np.errstate(all="ignore")
    def states_of_objects(self, qpos: Doubles, qvel: Doubles) -> Floats:
        """Return the states (13, k, n) of k objects with qpos (n, k, 7) and qvel (n, k, 6)."""
        states = np.empty((STATE_SIZE, *qpos.T.shape[1:]), dtype=np.float32)
        fill_free_states(states, qpos.T, qvel.T)
        return states

    @np.errstate(all="ignore")
    def object_rows(self, states: Tensor) -> tuple[Doubles, Doubles]:
        """Return qpos (n, k, 7) and qvel (n, k, 6) of k objects with states (n, k, 13)."""
        qpos, qvel = free_joint_coordinates(states.numpy().T.astype(np.float64))
        return qpos.T, qvel.T

    @np.errstate(all="ignore")
    def rows(
        self, root_states: Tensor, dof_pos: Tensor, dof_vel: Tensor
    ) -> tuple[Doubles, Doubles]:
        """Return qpos (n, nq) and qvel (n, nv) of n states in the layout of `SimulationBackend`.

        The objects have their poses in the model and are at rest.
        """
        layout = self._layout
        angles = dof_pos.numpy().T.astype(np.float64)
        num_objects = len(layout.object_names)
        qpos = np.empty((layout.num_qpos + QPOS_SIZE * num_objects, len(dof_pos)))
        qvel = np.empty((layout.num_qvel + QVEL_SIZE * num_objects, len(dof_pos)))
        if layout.has_free_root:
            root = root_states.numpy().T.astype(np.float64)
            qpos[:7], qvel[:6] = free_joint_coordinates(root)
        qpos[layout.scalar_qpos] = angles[layout.scalar_dofs]
        if self._ball_qpos.size > 0:
            vectors = angles[self._ball_dofs]
            length = np.sqrt(np.square(vectors).sum(axis=0))
            xyz = vectors * (np.sin(0.5 * length) / np.maximum(length, MIN_LENGTH))
            qpos[self._ball_qpos] = np.concatenate((xyz, np.cos(0.5 * length)[None]))
        qvel[layout.dof_vel_adr : layout.num_qvel] = dof_vel.numpy().T
        qpos[layout.num_qpos :] = self._objects_qpos0[:, None]
        qvel[layout.num_qvel :] = 0.0
        return qpos.T, qvel.T


def fill_free_states(states: Floats, qpos: Floats | Doubles, qvel: Floats | Doubles) -> None:
    """Compute states (13, ..., n) from qpos (7, ..., n) and qvel (6, ..., n) of free joints."""
    states[:7] = qpos[_QPOS_ROWS]
    states[7:] = qvel
    rotations = unit_quats(states[3:7].copy())
    states[10:] = rotate_components(rotations, states[10:])


def free_joint_coordinates(states: Doubles) -> tuple[Doubles, Doubles]:
    """Return qpos (7, ..., n) and qvel (6, ..., n) of states (13, ..., n).

    The length of the quaternion in a state has no influence on the velocity.
    """
    qpos = np.empty((QPOS_SIZE, *states.shape[1:]))
    qpos[_QPOS_ROWS] = states[:7]
    qvel = states[7:].copy()
    length = np.sqrt(np.square(states[3:7]).sum(axis=0))
    x, y, z, w = states[3:7] / np.maximum(length, MIN_LENGTH)
    qvel[3:] = rotate_components((-x, -y, -z, w), states[10:])
    return qpos, qvel
