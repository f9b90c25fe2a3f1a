"""States of free-floating bodies: the 13 numbers that tasks read, and MuJoCo's free joints.

A state is position, rotation xyzw, linear and angular velocity in world axes. Components come
first, then any bodies, the environments last. MuJoCo orders quaternions wxyz and keeps the angular
velocity of a free joint in the body's own frame; its quaternions need not be of unit length.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.simulation.kinematic_tree import MIN_LENGTH, Floats, unit_quats
from isaacgymenvs_lite.utils.rotations import rotate_components, xyzw_from_wxyz

Doubles = npt.NDArray[np.float64]

STATE_SIZE = 13
QPOS_SIZE = 7
QVEL_SIZE = 6
# Where in qpos position and rotation xyzw of a state are.
_QPOS_ROWS = np.append(np.arange(3), xyzw_from_wxyz(torch.arange(3, 7)).numpy())


def fill_free_states(states: Floats, qpos: Floats | Doubles, qvel: Doubles) -> None:
    """Compute states from the coordinates of free joints.

    Args:
        states: (13, ..., n), filled in.
        qpos: (7, ..., n).
        qvel: (6, ..., n).
    """
    states[:7] = qpos[_QPOS_ROWS]
    states[7:] = qvel
    rotations = unit_quats(states[3:7].copy())
    states[10:] = rotate_components(rotations, states[10:])


def free_joint_coordinates(states: Doubles) -> tuple[Doubles, Doubles]:
    """Return qpos (7, ..., n) and qvel (6, ..., n) of states (13, ..., n).

    Rotations of another than unit length do not scale the velocity.
    """
    qpos = np.empty((QPOS_SIZE, *states.shape[1:]))
    qpos[_QPOS_ROWS] = states[:7]
    qvel = states[7:].copy()
    length = np.sqrt(np.square(states[3:7]).sum(axis=0))
    x, y, z, w = states[3:7] / np.maximum(length, MIN_LENGTH)
    qvel[3:] = rotate_components((-x, -y, -z, w), states[10:])
    return qpos, qvel
