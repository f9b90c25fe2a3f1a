"""Contact forces and torques on bodies, from contact sensors of the model."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.utils.rotations import cross_components

# A contact sensor measures a force, a torque and a point. Frame sensors measure a position and
# three axes.
_CONTACT_SIZE, _FRAME_SIZE = 9, 12
_FRAME_SENSORS = {
    "position": mujoco.mjtSensor.mjSENS_FRAMEPOS,
    "xaxis": mujoco.mjtSensor.mjSENS_FRAMEXAXIS,
    "yaxis": mujoco.mjtSensor.mjSENS_FRAMEYAXIS,
    "zaxis": mujoco.mjtSensor.mjSENS_FRAMEZAXIS,
}
NET_FORCE = 3  # MuJoCo's number of reduce="netforce"


def add_wrench_sensors(spec: mujoco.MjSpec, bodies: Sequence[str]) -> None:
    """Add the sensors that `measure_wrenches` reads to a model."""
    body = mujoco.mjtObj.mjOBJ_BODY
    force, torque, point = (
        int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}"))
        for name in ("FORCE", "TORQUE", "POS")
    )
    for name in bodies:
        sensor = spec.add_sensor(
            name=f"wrench_{name}", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=body, objname=name
        )
        sensor.intprm[:3] = (1 << force | 1 << torque | 1 << point, NET_FORCE, 1)
    for name in bodies:
        for what, kind in _FRAME_SENSORS.items():
            frame = mujoco.mjtObj.mjOBJ_XBODY
            spec.add_sensor(name=f"{what}_{name}", type=kind, objtype=frame, objname=name)


def measure_wrenches(simulation: SimulationBackend, bodies: Sequence[str]) -> Tensor:
    """Return the contact forces and torques on K bodies as rows (6 K, N), body after body.

    `body_wrenches` has the frames and units of a body's six rows. The values belong to the start of
    the last physics step. The model needs the sensors `wrench_<body>`, `position_<body>`,
    `xaxis_<body>`, `yaxis_<body>` and `zaxis_<body>` for every body.
    """
    contacts = [f"wrench_{body}" for body in bodies]
    frames = [f"{what}_{body}" for body in bodies for what in _FRAME_SENSORS]
    measured = simulation.sensor(*contacts, *frames).t()
    contact, frame = (
        part.unflatten(0, (len(bodies), -1)).transpose(0, 1)
        for part in measured.split([_CONTACT_SIZE * len(bodies), _FRAME_SIZE * len(bodies)])
    )
    wrenches = body_wrenches(contact, frame[:3], frame[3:].unflatten(0, (3, 3)))
    return wrenches.transpose(0, 1).flatten(0, 1)


def body_wrenches(contacts: Tensor, body_pos: Tensor, body_axes: Tensor) -> Tensor:
    """Return forces and torques (6, K, N) on K bodies, about their origins and in their frames.

    Args:
        contacts: (9, K, N) values of the contact sensors in world axes: the force that the body
            exerts, its torque about a point, and this point.
        body_pos: (3, K, N) m.
        body_axes: (3, 3, K, N) x, y and z axis of each body in world axes.
    """
    forces = -contacts[:3]
    levers = contacts[6:] - body_pos
    torques = torch.stack(cross_components(levers, forces)).sub_(contacts[3:6])
    along = body_axes.transpose(0, 1)
    wrenches = contacts.new_empty(contacts.shape[1], 6, contacts.shape[2]).transpose(0, 1)
    for part, vectors in ((wrenches[:3], forces), (wrenches[3:], torques)):
        # The components in the body frame are scalar products with the body axes.
        torch.mul(along[0], vectors[0], out=part)
        part.addcmul_(along[1], vectors[1]).addcmul_(along[2], vectors[2])
    return wrenches


def torques_about(wrench: Tensor, points: Tensor) -> Tensor:
    """Return the torques (3, P, N) about P points, of one force and torque (6, N) on a body.

    The points (P, 3) m are in the frame of `wrench`. `wrench` is a force in newton and a torque in
    Nm about the origin of its frame.
    """
    force, torque = wrench[:3, None], wrench[3:, None]
    levers = cross_components(points.t()[..., None].unbind(), force.unbind())
    return torque - torch.stack(levers)
