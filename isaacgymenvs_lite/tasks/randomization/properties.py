"""Maps attributes of `actor_params` to fields of the MuJoCo model of each environment.

The names are PhysX's. Two quantities need a translation:

- Friction of shapes: for two touching shapes, PhysX uses the mean coefficient and MuJoCo the larger
  coefficient. The robot's geoms get the mean of their coefficient and the ground's. The ground gets
  the coefficient 0.
- Stiffness and damping of degrees of freedom: they are gains of the position drive, or springs and
  dampers of a joint without a position drive.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.simulation.model_layout import ModelLayout

Doubles = npt.NDArray[np.float64]
Ids = npt.NDArray[np.integer]


class Property(ABC):
    """One attribute of k bodies, geoms or degrees of freedom, with `original` values (k,)."""

    original: Doubles
    changes_constants = False  # whether MuJoCo derives other fields from this one
    left_out = ""  # parts of the robot without this attribute, which the log names

    @abstractmethod
    def write(self, env_ids: Ids, values: Doubles) -> None:
        """Set the values (n, k) in environments (n,)."""


class FieldProperty(Property):
    """Rows `ids` (k,) of a field of `MjModel`, or one `column` of these rows."""

    def __init__(
        self, simulation: SimulationBackend, field: str, ids: Ids, column: int | None = None
    ) -> None:
        # The original values come from the model, because environments may already be randomised.
        values, original = simulation.expand(field), getattr(simulation.model, field)[ids]
        self._values = values if column is None else values[..., column]
        self._ids = ids
        self.original = np.array(original if column is None else original[..., column], float)

    def write(self, env_ids: Ids, values: Doubles) -> None:
        """See `Property.write`."""
        self._values[np.ix_(env_ids, self._ids)] = values


class Mass(FieldProperty):
    """Masses in kg. The inertia of a body changes in proportion to its mass."""

    changes_constants = True

    def __init__(self, simulation: SimulationBackend, bodies: Ids) -> None:
        super().__init__(simulation, "body_mass", bodies)
        self._inertias = simulation.expand("body_inertia")
        self._inertia = simulation.model.body_inertia[bodies].copy()

    def write(self, env_ids: Ids, values: Doubles) -> None:
        """See `Property.write`."""
        values = np.maximum(values, mujoco.mjMINVAL)
        super().write(env_ids, values)
        ratio = values / np.maximum(self.original, mujoco.mjMINVAL)
        self._inertias[np.ix_(env_ids, self._ids)] = self._inertia * ratio[..., None]


class InverseMass(Property):
    """Reciprocal masses, 1/kg."""

    changes_constants = True

    def __init__(self, mass: Mass) -> None:
        self._mass = mass
        self.original = 1.0 / np.maximum(mass.original, mujoco.mjMINVAL)

    def write(self, env_ids: Ids, values: Doubles) -> None:
        """See `Property.write`."""
        self._mass.write(env_ids, 1.0 / np.maximum(values, mujoco.mjMINVAL))


class Friction(Property):
    """Friction coefficients of geoms (k,) with the ground (see the module docstring).

    The column is 0 for sliding, 1 for torsional and 2 for rolling friction.
    """

    def __init__(self, simulation: SimulationBackend, geoms: Ids, column: int) -> None:
        self._ids = geoms
        self._values = simulation.expand("geom_friction")[..., column]
        self._ground = 0.0
        floor = mujoco.mj_name2id(simulation.model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
        if floor >= 0:
            self._ground = float(simulation.model.geom_friction[floor, column])
            self._values[:, floor] = mujoco.mjMINMU
        # The model holds the mean of the geom's and the ground's coefficient.
        self.original = 2.0 * simulation.model.geom_friction[geoms, column] - self._ground

    def write(self, env_ids: Ids, values: Doubles) -> None:
        """See `Property.write`."""
        mean = 0.5 * (values + self._ground)
        self._values[np.ix_(env_ids, self._ids)] = np.maximum(mean, 0.0)


class Gain(Property):
    """Stiffness (column 1) or damping (column 2) of the drives or joints of degrees of freedom.

    A ball joint without a drive for each axis is left out, because a spring acts on all axes.
    """

    def __init__(self, simulation: SimulationBackend, layout: ModelLayout, column: int) -> None:
        model = simulation.model
        drives = _drives_of(model, layout)
        dofs = np.union1d(layout.scalar_dofs, np.flatnonzero(drives >= 0))
        self.left_out = "ball joints" if len(dofs) < layout.num_dofs else ""
        self._drives = drives[dofs]
        self._column = column
        self._gains = simulation.expand("actuator_gainprm") if column == 1 else None
        self._biases = simulation.expand("actuator_biasprm")
        rows = dofs + layout.dof_vel_adr
        passive = ("jnt_stiffness", model.dof_jntid[rows]) if column == 1 else ("dof_damping", rows)
        self._joint = FieldProperty(simulation, *passive)
        self.original = self._joint.original.copy()
        self._driven = driven = self._drives >= 0
        self._driven_by = by = self._drives[driven]
        self.original[driven] = -model.actuator_biasprm[by, column]
        # Gain and bias differ where MuJoCo must not recognise a servo (see `set_actuators`).
        self._near = (column == 1) & (
            model.actuator_biasprm[by, 1] != -model.actuator_gainprm[by, 0]
        )

    def write(self, env_ids: Ids, values: Doubles) -> None:
        """See `Property.write`."""
        values = np.maximum(values, 0.0)
        self._joint.write(env_ids, np.where(self._driven, self._joint.original, values))
        places = np.ix_(env_ids, self._driven_by)
        gains = values[:, self._driven]
        biases = np.where(self._near, np.nextafter(-gains, 0.0), -gains)
        self._biases[(*places, self._column)] = biases
        if self._gains is not None:
            self._gains[(*places, 0)] = gains


def _drives_of(model: mujoco.MjModel, layout: ModelLayout) -> Ids:
    """Return the ids (D,) of the position drives of degrees of freedom, or -1 for none."""
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    servo = affine & (model.actuator_biasprm[:, 1] != 0.0)
    on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    drives = np.full(layout.num_dofs, -1, dtype=np.int64)
    for actuator in np.flatnonzero(servo & on_joint):
        joint = model.actuator_trnid[actuator, 0]
        dof = model.jnt_dofadr[joint] - layout.dof_vel_adr
        if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_BALL):
            dof += int(np.abs(model.actuator_gear[actuator, :3]).argmax())
        if 0 <= dof < layout.num_dofs:  # other DOFs belong to objects
            drives[dof] = actuator
    return drives


def bodies_of_actors(
    model: mujoco.MjModel, layout: ModelLayout, actors: Mapping[str, str]
) -> dict[str, Ids]:
    """Map the names of actors to the ids of their bodies; see `DomainRandomizer`."""
    roots = {actor: model.body(body).id if body else 0 for actor, body in actors.items()}
    owners = np.zeros(model.nbody, dtype=np.int64)  # the actor's first body, 0 for the robot
    for body in range(1, model.nbody):
        owners[body] = body if body in roots.values() else owners[model.body_parentid[body]]
    owners[0] = -1
    owners[1 + len(layout.body_names) :][owners[1 + len(layout.body_names) :] == 0] = -1
    return {actor: np.flatnonzero(owners == root) for actor, root in roots.items()}


def make_property(
    simulation: SimulationBackend, layout: ModelLayout, bodies: Ids, group: str, attribute: str
) -> Property | None:
    """Return a property of an actor with these bodies, or None if MuJoCo has no counterpart.

    `group` and `attribute` are a key and a value of `settings.PROPERTIES`, or `scale` and ''. The
    degrees of freedom and tendons of the model belong to the robot.
    """
    model = simulation.model
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    dofs = np.arange(layout.num_dofs) + layout.dof_vel_adr
    columns = {"friction": 0, "torsion_friction": 1, "rolling_friction": 2}
    if group == "scale":
        return Scale(simulation, geoms) if _is_free_body(model, bodies) else None
    if group == "rigid_body_properties":
        mass = Mass(simulation, bodies[model.body_mass[bodies] > 0.0])
        return mass if attribute == "mass" else InverseMass(mass)
    if group == "rigid_shape_properties" and attribute in columns:
        return Friction(simulation, geoms, columns[attribute])
    if group == "tendon_properties" and attribute in _TENDON_FIELDS and model.ntendon > 0:
        field, column = _TENDON_FIELDS[attribute]
        if not getattr(model, field).any():
            return None  # for example the stiffness of a tendon that only has limits
        return FieldProperty(simulation, field, np.arange(model.ntendon), column)
    if group == "dof_properties":
        if attribute in ("lower", "upper"):
            return Limits(simulation, layout, int(attribute == "upper"))
        if attribute in ("stiffness", "damping"):
            return Gain(simulation, layout, 1 if attribute == "stiffness" else 2)
        if attribute in ("friction", "armature"):
            field = {"friction": "dof_frictionloss", "armature": "dof_armature"}[attribute]
            return FieldProperty(simulation, field, dofs)
        if attribute == "effort" and (model.actuator_forcelimited != 0).any():
            return Effort(simulation)
    return None


_TENDON_FIELDS = {
    "stiffness": ("tendon_stiffness", None),
    "damping": ("tendon_damping", None),
    "fixed_lower_limit": ("tendon_range", 0),
    "fixed_upper_limit": ("tendon_range", 1),
}


def _is_free_body(model: mujoco.MjModel, bodies: Ids) -> bool:
    """Return whether an actor is one body with a free joint, which can be scaled."""
    joints = model.body_jntadr[bodies]
    return (
        len(bodies) == 1
        and joints[0] >= 0
        and (model.jnt_type[joints[0]] == mujoco.mjtJoint.mjJNT_FREE)
    )


class Scale(Property):
    """The scale of the geoms (k,) of a free body. Mass and inertia stay."""

    _FIELDS = ("geom_size", "geom_pos", "geom_rbound", "geom_aabb")

    def __init__(self, simulation: SimulationBackend, geoms: Ids) -> None:
        model = simulation.model
        body = int(model.geom_bodyid[geoms[0]])
        volumes = model.body_bvhadr[body] + np.arange(model.body_bvhnum[body])
        rows = {**dict.fromkeys(self._FIELDS, geoms), "bvh_aabb": volumes}
        self._parts = [
            (simulation.expand(name), ids, getattr(model, name)[ids]) for name, ids in rows.items()
        ]
        self.original = np.ones(1)

    def write(self, env_ids: Ids, values: Doubles) -> None:
        """See `Property.write`."""
        for own, ids, original in self._parts:
            scales = np.maximum(values, mujoco.mjMINVAL).reshape(-1, *(1,) * original.ndim)
            own[np.ix_(env_ids, ids)] = original * scales


class Limits(FieldProperty):
    """Lower (column 0) or upper (column 1) limits of hinges (rad) and slides (m).

    Ball joints are left out, because MuJoCo limits only their total angle.
    """

    def __init__(self, simulation: SimulationBackend, layout: ModelLayout, column: int) -> None:
        model = simulation.model
        joints = model.dof_jntid[np.asarray(layout.scalar_dofs) + layout.dof_vel_adr]
        limited = joints[model.jnt_limited[joints] != 0]
        super().__init__(simulation, "jnt_range", limited, column)
        self.left_out = "ball joints" if layout.ball_dofs.size else ""


class Effort(Property):
    """Largest forces of actuators (newton or Nm) in both directions."""

    def __init__(self, simulation: SimulationBackend) -> None:
        ids = np.flatnonzero(simulation.model.actuator_forcelimited)
        self._lower = FieldProperty(simulation, "actuator_forcerange", ids, 0)
        self._upper = FieldProperty(simulation, "actuator_forcerange", ids, 1)
        self.original = self._upper.original

    def write(self, env_ids: Ids, values: Doubles) -> None:
        """See `Property.write`."""
        values = np.maximum(values, 0.0)
        self._lower.write(env_ids, -values)
        self._upper.write(env_ids, values)
