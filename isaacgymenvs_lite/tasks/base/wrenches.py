"""Contact forces and torques on bodies, from what `contact` sensors of a model measure."""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.utils.rotations import cross_components, rotate_components


def body_wrenches(contacts: Tensor, body_pos: Tensor, body_rot: Tensor) -> Tensor:
    """Return (6, K, N) contact force and torque on K bodies, about and in the frames of the bodies.

    Args:
        contacts: (9, K, N) what `contact` sensors measure, in world axes: the force that the body
            exerts, its torque about a point, and that point.
        body_pos: (3, K, N) m.
        body_rot: (4, K, N) xyzw.
    """
    back = (*(-body_rot[:3]).unbind(), body_rot[3])
    exerted, points = contacts[:3].unbind(), (contacts[6:] - body_pos).unbind()
    moved = cross_components(points, exerted)
    torques = [-(own + lever) for own, lever in zip(contacts[3:6], moved, strict=True)]
    forces = [-force for force in exerted]
    return torch.stack((*rotate_components(back, forces), *rotate_components(back, torques)))


def torques_about(wrench: Tensor, points: Tensor) -> Tensor:
    """Return (3, P, N) torques about P points of the force and torque (6, N) on a body.

    Args:
        wrench: (6, N) N and Nm, about the origin of the frame in which the points are.
        points: (P, 3) m.
    """
    force, torque = wrench[:3, None], wrench[3:, None]
    levers = cross_components(points.t()[..., None].unbind(), force.unbind())
    return torque - torch.stack(levers)
