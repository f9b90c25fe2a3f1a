"""What every simulation backend offers to tasks: the Protocol, tensor by tensor.

A backend holds `num_envs` copies of one MuJoCo model. Tasks read and write float32 torch tensors
on `device`, in Isaac Gym's layout: quaternions are xyzw, positions and velocities are in world
axes relative to the environment's own origin, and the positions of a 3-DoF ball joint are its
rotation vector (exponential map) in the child frame.

The state tensors are preallocated and updated in place by `step` and `write_state`: keep the
reference, copy what must outlive the next step. A backend may keep each component of all
environments together in memory (`cpu_batch` does): take `reshape` or `flatten`, not `view`.
"""

from __future__ import annotations

from typing import Protocol

import mujoco
import torch
from torch import Tensor


class SimulationBackend(Protocol):
    """N simulations of one model. B bodies (without the world), D degrees of freedom, U actuators.

    The D degrees of freedom are those of all joints but the free root joint, in file order; a ball
    joint counts three.
    """

    model: mujoco.MjModel
    num_envs: int
    device: torch.device

    substeps: int
    """Physics steps of one `step()`: one control step of the task."""

    body_names: tuple[str, ...]
    """B names in the order of the body tensors."""

    dof_names: tuple[str, ...]
    """D names; a ball joint `hip` gives hip_x, hip_y, hip_z."""

    num_failures: int
    """How often a simulation diverged since the start, all environments together."""

    @property
    def dt(self) -> float:
        """Simulated time of one `step()` in s."""
        ...

    @property
    def root_states(self) -> Tensor:
        """(N, 13) position, rotation xyzw, linear and angular velocity of the free root body.

        All in world axes, of the body's origin; m, m/s, rad/s.
        """
        ...

    @property
    def dof_pos(self) -> Tensor:
        """(N, D) rad (or m for slide joints); rotation vectors for ball joints."""
        ...

    @property
    def dof_vel(self) -> Tensor:
        """(N, D) rad/s (or m/s); child-frame angular velocity for ball joints."""
        ...

    @property
    def body_pos(self) -> Tensor:
        """(N, B, 3) world positions of the body origins (m)."""
        ...

    @property
    def body_rot(self) -> Tensor:
        """(N, B, 4) world rotations of the bodies, xyzw."""
        ...

    @property
    def body_lin_vel(self) -> Tensor:
        """(N, B, 3) linear velocities of the body origins in world axes (m/s)."""
        ...

    @property
    def body_ang_vel(self) -> Tensor:
        """(N, B, 3) angular velocities of the bodies in world axes (rad/s)."""
        ...

    @property
    def contact_forces(self) -> Tensor:
        """(N, B, 3) net contact force on each body in world axes (N).

        Of the last physics step; zero for environments written since then.
        """
        ...

    @property
    def failed(self) -> Tensor:
        """(N,) bool: the simulation diverged in the last `step()`.

        It was put back to its default state; the task should end the episode.
        """
        ...

    def set_controls(self, controls: Tensor) -> None:
        """Set the actuators' controls, (N, U), for the next steps."""
        ...

    def step(self) -> None:
        """Advance all simulations by `substeps` physics steps and refresh the state tensors."""
        ...

    def write_state(
        self, env_ids: Tensor, root_states: Tensor, dof_pos: Tensor, dof_vel: Tensor
    ) -> None:
        """Put n environments into a new state and recompute their body tensors.

        All memory of the earlier state (warm start, controls, contact forces) is cleared; the
        other environments are left bit-identical.

        Args:
            env_ids: (n,) int64.
            root_states: (n, 13) as `root_states`.
            dof_pos: (n, D) as `dof_pos`.
            dof_vel: (n, D) as `dof_vel`.
        """
        ...

    def close(self) -> None:
        """Free the simulations and their threads; the backend cannot be used afterwards."""
        ...
