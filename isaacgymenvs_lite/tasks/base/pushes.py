"""Pushes: sudden changes of the velocities of bases over the ground."""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.backend import SimulationBackend


def push_interval(interval_s: float, control_dt_s: float) -> int:
    """Return the control steps from one push to the next, at least 1.

    Args:
        interval_s: from one push to the next, s.
        control_dt_s: time of a control step, s.
    """
    return max(1, int(interval_s / control_dt_s + 0.5))


def set_planar_velocities(simulation: SimulationBackend, velocities_w: Tensor) -> None:
    """Give all bases other velocities over the ground; everything else stays as it is.

    Contact forces are zero until the next step, as after any new state.

    Args:
        simulation: of N environments.
        velocities_w: (N, 2) along x and y of the world, m/s.
    """
    env_ids = torch.arange(simulation.num_envs, device=simulation.device)
    root = simulation.root_states.clone()
    root[:, 7:9] = velocities_w
    objects = simulation.object_states.clone()
    simulation.write_state(env_ids, root, simulation.dof_pos, simulation.dof_vel)
    if simulation.object_names:  # a new state puts them back to where they were at first
        object_ids = torch.arange(len(simulation.object_names), device=simulation.device)
        simulation.write_object_states(env_ids, object_ids, objects)
