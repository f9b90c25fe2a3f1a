"""Pushes: sudden changes of the horizontal velocities of robot bases."""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.backend import SimulationBackend


def push_interval(interval_s: float, control_dt_s: float) -> int:
    """Return the number of control steps between pushes, at least 1."""
    return max(1, int(interval_s / control_dt_s + 0.5))


def set_planar_velocities(simulation: SimulationBackend, velocities_w: Tensor) -> None:
    """Set the velocities (N, 2) of all bases along world x and y (m/s).

    The rest of the state does not change. Contact forces are zero until the next step.
    """
    env_ids = torch.arange(simulation.num_envs, device=simulation.device)
    root = simulation.root_states.clone()
    root[:, 7:9] = velocities_w
    objects = simulation.object_states.clone()
    simulation.write_state(env_ids, root, simulation.dof_pos, simulation.dof_vel)
    if simulation.object_names:  # `write_state` moved the objects to their initial states
        object_ids = torch.arange(len(simulation.object_names), device=simulation.device)
        simulation.write_object_states(env_ids, object_ids, objects)
