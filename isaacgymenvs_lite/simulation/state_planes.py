"""From MuJoCo's coordinates to the float32 state that tasks read, and back.

The state of many environments is kept component-major: one contiguous plane (a number per
environment) for each component. Reductions and rotations over components, which is most of what
tasks do, then run along memory, in a fraction of the time that rows of three or four numbers take.
"""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.forward_kinematics import MIN_LENGTH, Floats, ForwardKinematics
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.utils.rotations import quat_log, rotate_components, xyzw_from_wxyz

Doubles = npt.NDArray[np.float64]


class StatePlanes:
    """The state of n environments with B bodies and D degrees of freedom, float32.

    All arrays look into one piece of memory and are zero at first; names and units as in
    `SimulationBackend`, with the environments last.

    Attributes:
        root_states: (13, n).
        dof_pos: (D, n).
        dof_vel: (D, n).
        velocities: (6 + D, n) of the root, then `dof_vel`.
        body_pos: (3, B, n).
        body_rot: (4, B, n).
        contact_forces: (3, B, n).
    """

    def __init__(self, layout: ModelLayout, num_envs: int) -> None:
        num_dofs, num_bodies = layout.num_dofs, len(layout.body_names)
        first_body_row = 13 + 2 * num_dofs
        self._all = np.zeros((first_body_row + 10 * num_bodies, num_envs), dtype=np.float32)
        self.root_states = self._all[:13]
        self.dof_vel = self._all[13 : 13 + num_dofs]
        self.velocities = self._all[7 : 13 + num_dofs]
        self.dof_pos = self._all[13 + num_dofs : first_body_row]
        bodies = self._all[first_body_row:].reshape(10, num_bodies, num_envs)
        self.body_pos, self.body_rot, self.contact_forces = bodies[:3], bodies[3:7], bodies[7:]

    def replace(self, env_ids: npt.NDArray[np.integer], others: StatePlanes) -> None:
        """Put the n environments of `others` in place of `env_ids` (n,)."""
        # torch's is several times as fast as numpy's indexing.
        mine, theirs = torch.from_numpy(self._all), torch.from_numpy(others._all)
        mine.index_copy_(1, torch.from_numpy(env_ids), theirs)


def tensor_of_planes(planes: Floats) -> Tensor:
    """Return planes (d, n) or (d, B, n) as a tensor (n, d) or (n, B, d) on the same memory."""
    return torch.from_numpy(planes.T)


class StateConverter:
    """Makes planes from rows of qpos and qvel, and such rows from states.

    Args:
        model: the compiled model.
        layout: its layout.
    """

    def __init__(self, model: mujoco.MjModel, layout: ModelLayout) -> None:
        self._layout = layout
        self._kinematics = ForwardKinematics(model)
        self._num_qpos = int(model.nq)
        self._ball_qpos = layout.ball_qpos.T
        self._ball_dofs = layout.ball_dofs.T
        root_rot = xyzw_from_wxyz(torch.arange(3, 7)).numpy()
        self._root_body = int(model.jnt_bodyid[0]) - 1 if layout.has_free_root else 0
        self._root_qpos = np.concatenate((np.arange(3), root_rot))

    @np.errstate(all="ignore")  # a simulation may be on its way to infinity
    def fill(self, planes: StatePlanes, qpos_rows: Doubles, qvel_rows: Doubles) -> None:
        """Fill in all but the contact forces.

        Args:
            planes: of n environments.
            qpos_rows: (n, nq) in MuJoCo's conventions.
            qvel_rows: (n, nv) in MuJoCo's conventions.
        """
        layout = self._layout
        qpos = np.ascontiguousarray(qpos_rows.T, dtype=np.float32)
        self._kinematics(qpos, planes.body_pos, planes.body_rot)
        planes.dof_vel[:] = qvel_rows.T[layout.dof_vel_adr :]
        if layout.has_free_root:
            root = planes.root_states
            root[:7] = qpos[self._root_qpos]
            root[7:] = qvel_rows.T[:6]
            # MuJoCo keeps the angular velocity of a free joint in the body's own frame. The body's
            # rotation is of unit length, other than perhaps qpos.
            root_rot = planes.body_rot[:, self._root_body]
            root[10:] = rotate_components(root_rot, root[10:])
        planes.dof_pos[layout.scalar_dofs] = qpos[layout.scalar_qpos]
        if self._ball_qpos.size > 0:
            quats = torch.from_numpy(qpos[self._ball_qpos]).permute(2, 1, 0)
            planes.dof_pos[self._ball_dofs] = quat_log(quats).permute(2, 1, 0).numpy()

    @np.errstate(all="ignore")
    def rows(
        self, root_states: Tensor, dof_pos: Tensor, dof_vel: Tensor
    ) -> tuple[Doubles, Doubles]:
        """Return qpos (n, nq) and qvel (n, nv) of the states of n environments.

        Args:
            root_states: (n, 13) as `SimulationBackend.root_states`.
            dof_pos: (n, D) as `SimulationBackend.dof_pos`.
            dof_vel: (n, D) as `SimulationBackend.dof_vel`.
        """
        layout = self._layout
        angles = dof_pos.numpy().T.astype(np.float64)
        qpos = np.empty((self._num_qpos, len(dof_pos)))
        qvel = np.empty((layout.dof_vel_adr + layout.num_dofs, len(dof_pos)))
        if layout.has_free_root:
            root = root_states.numpy().T.astype(np.float64)
            qpos[self._root_qpos] = root[:7]
            qvel[:3] = root[7:10]
            length = np.sqrt(np.square(root[3:7]).sum(axis=0))
            x, y, z, w = root[3:7] / np.maximum(length, MIN_LENGTH)
            qvel[3:6] = rotate_components((-x, -y, -z, w), root[10:])
        qpos[layout.scalar_qpos] = angles[layout.scalar_dofs]
        if self._ball_qpos.size > 0:
            vectors = angles[self._ball_dofs]
            length = np.sqrt(np.square(vectors).sum(axis=0))
            xyz = vectors * (np.sin(0.5 * length) / np.maximum(length, MIN_LENGTH))
            qpos[self._ball_qpos] = np.concatenate((xyz, np.cos(0.5 * length)[None]))
        qvel[layout.dof_vel_adr :] = dof_vel.numpy().T
        return qpos.T, qvel.T
