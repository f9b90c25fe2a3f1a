"""Free boxes that are added to the model of a character."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco

from isaacgymenvs_lite.simulation.model_layout import CONTACT_SENSOR_PREFIX
from isaacgymenvs_lite.tasks.base.wrenches import NET_FORCE

_DAMPING = 0.01  # 1/s
_RGBA = (0.72, 0.36, 0.30, 1.0)
_FRICTION = (1.0, 0.05, 0.05)


def add_box(
    spec: mujoco.MjSpec,
    name: str,
    size_m: tuple[float, float, float],
    density: float,
    position_m: tuple[float, float, float],
) -> None:
    """Add a free box and a sensor of its net contact force to a model that is not yet compiled.

    The edge lengths `size_m` and the centre `position_m` are in m, and `density` is in kg/m^3.
    """
    body = spec.worldbody.add_body(name=name, pos=position_m)
    body.add_freejoint(name=name)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.5 * edge for edge in size_m],
        density=density,
        condim=3,
        friction=_FRICTION,
        rgba=_RGBA,
    )
    spec.add_sensor(
        name=f"{CONTACT_SENSOR_PREFIX}{name}",
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        objname=name,
        intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), NET_FORCE, 1],
    )


def damp_objects(model: mujoco.MjModel, names: Iterable[str]) -> None:
    """Damp the linear and angular velocities of the named free bodies in a compiled model."""
    for name in names:
        body = model.body(name)
        first = int(body.dofadr[0])
        model.dof_damping[first : first + 3] = _DAMPING * body.mass
        model.dof_damping[first + 3 : first + 6] = _DAMPING * body.inertia
