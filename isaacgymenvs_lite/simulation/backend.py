"""The Protocol of a simulation backend, tensor by tensor, and `make_simulation`, which makes one.

A backend holds `num_envs` copies of one MuJoCo model. Tasks read and write float32 torch tensors
on `device`, in Isaac Gym's layout: quaternions are xyzw, positions and velocities are in world
axes relative to the environment's own origin, and the positions of a 3-DoF ball joint are its
rotation vector (exponential map) in the child frame.

The state tensors are preallocated and updated in place by `step` and by writes: keep the
reference, copy what must outlive the next step. Only the tensors of bodies (`body_...`), joint
forces and sensors are computed when they are read: read the property again after each step or
write. A backend may keep each component of all environments together in memory (`cpu_batch` does):
take `reshape` or `flatten`, not `view`.

Beside the robot a model may have objects: bodies without children, each on a free joint of its own,
after all bodies of the robot in the file. Body and DOF tensors do not contain them.
"""

from __future__ import annotations

from collections.abc import Mapping
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

    The B bodies are all but the world and the objects. The D degrees of freedom belong to
    all joints but the free root joint and the objects', in file order; a ball joint counts three.
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

    object_names: tuple[str, ...]
    """K names in the order of the object tensors; none in models without objects."""

    root_states: Tensor
    """(N, 13) position, rotation xyzw, linear and angular velocity of the free root body.

    All in world axes, of the body's origin; m, m/s, rad/s.
    """

    dof_pos: Tensor
    """(N, D) rad (or m for slide joints); rotation vectors for ball joints."""

    dof_vel: Tensor
    """(N, D) rad/s (or m/s); child-frame angular velocity for ball joints."""

    contact_forces: Tensor
    """(N, B, 3) net contact force on each body in world axes (N).

    Of the last physics step; zero for environments written since then.
    """

    object_states: Tensor
    """(N, K, 13) as `root_states`, of the objects."""

    object_contact_forces: Tensor
    """(N, K, 3) net contact force on each object in world axes (N).

    Of the last physics step; zero for objects written since then, and if the model has no
    `contact_<object>` sensors.
    """

    failed: Tensor
    """(N,) bool: the simulation, the robot or an object, diverged in the last `step()`.

    Its state was not finite or beyond what is physical: MuJoCo's warnings BADQPOS, BADQVEL and
    BADQACC (an absolute value above 1e10), after which MuJoCo itself resets the simulation
    without an error, or a speed above 1000 rad/s or m/s. It was reset to its default state; the
    task ends the episode.
    """

    num_failures: int
    """How often a simulation diverged since the start, all environments together."""

    recordings: list[Recording]
    """The last steps of the first few simulations that diverged; whoever takes them removes them,
    which makes room for the next."""

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
        """(N, D) torques (Nm; N of slides) of actuators, springs and dampers on the joints.

        Of the last physics step; zero for environments written since then. Ball joints: in the
        child frame.
        """
        ...

    def sensor(self, *names: str) -> Tensor:
        """Return what named sensors of the model measured in the last physics step, (N, k).

        Zero for environments written since then. MuJoCo's units, and world axes unless the sensor
        has a frame of its own; `contact` sensors measure the force that their first body exerts.
        Sensors that are neighbours in the model, in this order, are read in one go.
        """
        ...

    def expand(self, field: str) -> npt.NDArray[Any]:
        """Give a field of the model a value for each environment; return them, (N, ...), to write.

        The field is one of `MjModel`, or `opt.<field>` of its options. Poses of bodies and joints
        (`body_pos`, `jnt_axis`, ...) must not be changed.
        """
        ...

    def update_constants(self, env_ids: npt.NDArray[np.integer]) -> None:
        """Recompute what MuJoCo derives from fields such as masses, of `env_ids` (n,)."""
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
        """Set n environments, each once, to root states (n, 13), positions and velocities (n, D).

        Their objects go back to their places in the model, at rest. All memory of the earlier state
        (warm start, controls, contact forces) is cleared; the other environments are left
        bit-identical.
        """
        ...

    def write_object_states(self, env_ids: Tensor, object_ids: Tensor, states: Tensor) -> None:
        """Set k objects (places in `object_names`) of n environments to states (n, k, 13).

        Ids are given once, in any order. The rest of these environments, the robot included, and
        the other environments are left bit-identical. The solver's warm start of these environments
        is cleared, so that the next steps depend on their states and controls alone.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all that the next steps depend on, for `load_state_dict`."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state_dict` returned, bit by bit, in simulations of an equal model.

        A state of other simulations raises KeyError, TypeError, ValueError or RuntimeError.
        """
        ...

    def close(self) -> None:
        """Free the simulations and their threads; the backend cannot be used afterwards."""
        ...


def bytes_of_env(model: mujoco.MjModel) -> int:
    """Return how many bytes one simulation of a model takes at least, in any backend."""
    state = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    # Isaac Gym's layout: root, joints, and position, rotation, velocities and force of each body.
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
        num_threads: CPU worker threads; 0 for as many CPUs as have enough work.
        backend: `cpu_batch`, the only one so far.
    """
    from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation

    if backend != "cpu_batch":
        raise ConfigError(unknown("simulation backend", backend, ["cpu_batch"]))
    check_memory({"simulations": num_envs * bytes_of_env(model)}, f"num_envs ({num_envs} now)")
    return CpuBatchSimulation(model, num_envs, substeps, num_threads)
