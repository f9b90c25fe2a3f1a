"""Defines the Protocol of a simulation backend, tensor by tensor, and makes a backend.

A backend holds `num_envs` copies of one MuJoCo model. Tasks read and write float32 torch tensors on
`device`, in Isaac Gym's layout: quaternions are xyzw, positions and velocities are in world axes
relative to the origin of the environment, and the three positions of a ball joint are its rotation
vector (exponential map) in the child frame.

The state tensors are preallocated; `step` and writes update them in place. A caller may keep a
reference to these tensors, and must copy values that have to outlive the next step. The tensors of
bodies (`body_...`), joint forces and sensors are different: they are computed when the property is
read, so that the property must be read again after each step or write. The memory of a tensor need
not be contiguous, because `cpu_batch` keeps each component of all environments together: use
`reshape` or `flatten`, not `view`.

A model may have other parts than the robot:

- An object is a body with a free joint and without children. Objects come after all other bodies,
  and have tensors of their own.
- Furniture is a body at a fixed place, for example a table or a cabinet with doors. Its bodies and
  joints are part of the body and DOF tensors, after the robot's.
- A goal or another mark that touches nothing is no part of the model. The task's method `markers`
  returns it as a shape of `rendering.markers`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.simulation.recording import Recording
from isaacgymenvs_lite.utils.memory import check_memory


class SimulationBackend(Protocol):
    """N simulations of one model: B bodies, D degrees of freedom, U actuators, K objects.

    The world and the objects do not count as bodies. The D degrees of freedom belong to the joints
    in file order, without the free joints of root and objects; a ball joint has three degrees of
    freedom.
    """

    model: mujoco.MjModel
    num_envs: int
    device: torch.device

    substeps: int
    """Physics steps of one control step; `step()` makes one control step."""

    body_names: tuple[str, ...]
    """B names of bodies in the order of the body tensors."""

    dof_names: tuple[str, ...]
    """D names of degrees of freedom; a ball joint `hip` has the names hip_x, hip_y and hip_z."""

    object_names: tuple[str, ...]
    """K names of objects in the order of the object tensors."""

    root_states: Tensor
    """(N, 13) position (m), rotation xyzw, linear (m/s) and angular velocity (rad/s) of the root.

    Positions and velocities belong to the root body's origin and are in world axes.
    """

    dof_pos: Tensor
    """(N, D) rad (or m for slide joints); rotation vectors for ball joints."""

    dof_vel: Tensor
    """(N, D) rad/s (or m/s); child-frame angular velocity for ball joints."""

    contact_forces: Tensor
    """(N, B, 3) net contact force (newton) on each body in world axes in the last physics step.

    The force is zero for bodies without a sensor `contact_<body>` in the model, and for
    environments whose state has been set since that step.
    """

    object_states: Tensor
    """(N, K, 13) states of the objects, like `root_states`."""

    object_contact_forces: Tensor
    """(N, K, 3) net contact force (newton) on each object in world axes in the last physics step.

    The force is zero for objects whose state has been set since that step, and if the model has no
    `contact_<object>` sensors.
    """

    failed: Tensor
    """(N,) bool, whether the simulation diverged in the last `step()`.

    A simulation diverges if a speed exceeds 1000 rad/s or m/s, or if MuJoCo warns with BADQPOS,
    BADQVEL or BADQACC (a value is not finite or above 1e10) and resets the simulation. A diverged
    simulation is reset to its default state; the task ends the episode.
    """

    num_failures: int
    """Number of divergences of all environments since the start."""

    recordings: list[Recording]
    """The last steps of the first few diverged simulations. Code that reads a recording removes it
    from the list, which makes room for another recording."""

    @property
    def dt(self) -> float:
        """Simulated time of one `step()` in s."""
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
    def dof_forces(self) -> Tensor:
        """(N, D) torques (Nm) or forces (newton) of actuators, springs and dampers on the joints.

        The values are from the last physics step and zero for environments whose state has been set
        since that step. The torques of ball joints are in the child frame.
        """
        ...

    def sensor(self, *names: str) -> Tensor:
        """Return the values (N, k) of named sensors of the model in the last physics step.

        The values are zero for environments whose state has been set since that step. The values
        have MuJoCo's units and are in world axes unless the sensor defines a frame. A `contact`
        sensor measures the force that its first body exerts. Reading is fastest if the sensors are
        neighbours in the model, in the order of `names`.
        """
        ...

    def jacobian(self, body: str, dofs: Sequence[str]) -> Tensor:
        """Return d(velocity of a body) / d(velocities of k degrees of freedom), (N, 6, k).

        The first three rows belong to the linear velocity of the body's origin (m/s), and the last
        three rows to the angular velocity (rad/s), both in world axes. The values belong to the
        current state. The tensor is new in each call.
        """
        ...

    def mass_matrix(self, dofs: Sequence[str]) -> Tensor:
        """Return the block (N, k, k) of the mass matrix that belongs to k degrees of freedom.

        The unit is kg m^2 for hinges and kg for slides. The matrix includes armatures, and belongs
        to the current state. The tensor is new in each call.
        """
        ...

    def apply_forces(self, bodies: Sequence[str], forces: Tensor) -> None:
        """Apply forces (N, k, 3) in newton to the centres of mass of k bodies or objects.

        The forces are in world axes, and act during the whole next `step()` and not longer. A
        second call before this step replaces the forces on the bodies that it names. `write_state`
        removes the forces in its environments.
        """
        ...

    def expand(self, field: str) -> npt.NDArray[Any]:
        """Give each environment separate values of a model field; return the values (N, ...).

        The caller writes into the returned values. The field is a field of `MjModel` or
        `opt.<field>`. Poses of bodies and joints (`body_pos`, `jnt_axis`, ...) must not be changed.
        """
        ...

    def update_constants(self, env_ids: npt.NDArray[np.integer]) -> None:
        """Recompute the constants of envs (n,) that MuJoCo derives from masses and other fields."""
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
        """Set n different environments to root states (n, 13), DOF positions and velocities (n, D).

        The objects of these environments return to their poses in the model, at rest. Everything
        that depends on the earlier state (initial values of the solver, controls, contact forces)
        is cleared. The other environments do not change by a bit.
        """
        ...

    def write_object_states(self, env_ids: Tensor, object_ids: Tensor, states: Tensor) -> None:
        """Set k objects (indices of `object_names`) of n environments to states (n, k, 13).

        Ids must be unique and may have any order. No other object, no robot and no other
        environment changes by a bit. The initial values of the solver are cleared in the n
        environments, so that the next steps of these environments depend only on states and
        controls.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all values on which the next steps depend, for `load_state_dict`."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state_dict`; equal models then make equal steps, bit by bit.

        Raises:
            KeyError, TypeError, ValueError, RuntimeError: the state belongs to other simulations.
        """
        ...

    def close(self) -> None:
        """Release the simulations and their threads; the backend cannot be used afterwards."""
        ...


def bytes_of_env(model: mujoco.MjModel) -> int:
    """Return a lower bound of the bytes that any backend needs for one simulation of a model."""
    state = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    # Isaac Gym's layout has root, joints, and pose, velocities and force of each body.
    floats = 13 + 2 * model.nv + 16 * (model.nbody - 1)
    return 8 * state + 4 * floats


def make_simulation(
    model: mujoco.MjModel,
    num_envs: int,
    substeps: int,
    num_threads: int = 0,
    backend: str = "cpu_batch",
) -> SimulationBackend:
    """Make `num_envs` simulations of `model`.

    Args:
        model: the compiled model.
        num_envs: number of simulations.
        substeps: physics steps of one control step.
        num_threads: number of worker threads; 0 means one for each CPU, fewer for little work.
        backend: `cpu_batch`, which is the only backend.
    """
    from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation

    if backend != "cpu_batch":
        raise ConfigError(unknown("simulation backend", backend, ["cpu_batch"]))
    check_memory({"simulations": num_envs * bytes_of_env(model)}, f"num_envs ({num_envs} now)")
    return CpuBatchSimulation(model, num_envs, substeps, num_threads)
