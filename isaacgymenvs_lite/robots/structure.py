"""Turns the content of a file into one robot with a free root.

Bodies and joints get names; scenery, mounts, slides and loops are removed or refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError, listed, printable
from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.simulation.model_layout import CONTACT_SENSOR_PREFIX

_FREE, _SLIDE = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_SLIDE
_EQUALITY = mujoco.mjtEq
_OVERLAP = 0.002  # bodies that overlap by at most this (m) in the start pose only touch
# Maps fields of a model to a description, the largest value that a robot may have, and the unit.
_LARGEST = {
    "body_pos": ("position", 100.0, "m"),
    "body_quat": ("rotation", 1.01, "as a quaternion"),
    "body_mass": ("mass", 1e5, "kg"),
    "body_inertia": ("moment of inertia", 1e7, "kg m^2"),
    "geom_pos": ("position", 100.0, "m"),
    "geom_rbound": ("radius", 100.0, "m"),
    "jnt_pos": ("position", 100.0, "m"),
    "jnt_range": ("limit", 1e9, "rad"),
    "jnt_stiffness": ("stiffness", 1e7, "Nm/rad"),
    "dof_armature": ("armature", 1e5, "kg m^2"),
    "dof_damping": ("damping", 1e7, "Nm s/rad"),
    "dof_frictionloss": ("friction", 1e7, "Nm"),
}


def name_everything(spec: mujoco.MjSpec) -> list[str]:
    """Give nameless bodies and joints names like `body3` and `joint3`; return notes."""
    notes = []
    for kind, elements in (("body", spec.bodies[1:]), ("joint", spec.joints)):
        taken = {element.name for element in elements}
        named = []
        for number, element in enumerate(elements):
            if not element.name and not (kind == "joint" and element.type == _FREE):
                element.name = _free_name(f"{kind}{number}", taken)
                named.append(element.name)
        if named:
            notes.append(f"named {listed(named)}, which had no name")
    return notes


def _free_name(name: str, taken: Iterable[str]) -> str:
    return name if name not in taken else _free_name(f"{name}_", taken)


def keep_one_robot(spec: mujoco.MjSpec) -> tuple[mujoco.MjsBody, list[str]]:
    """Remove everything except the robot; return its root, and notes.

    Scenery (bodies without joints, all geoms of the world) and objects (free bodies without
    children) are removed. A plane that is the floor stays, because contact pairs may name it.

    Raises:
        ConfigError: the file has no robot or several robots.
    """
    roots = [body for body in spec.worldbody.bodies if not body.mocap and _moves(body)]
    robots = [body for body in roots if body.bodies or not _is_free(body)] or roots
    if not robots:
        raise ConfigError("has no joints: expected a robot with hinges or ball joints")
    if len(robots) > 1:
        names = ", ".join(body.name for body in robots)
        raise ConfigError(f"has {len(robots)} robots: {names}; expected one: remove the others")
    others = [body for body in spec.worldbody.bodies if body.name != robots[0].name]
    planes = [g for g in spec.worldbody.geoms if g.type == mujoco.mjtGeom.mjGEOM_PLANE]
    level = [g for g in planes if abs(g.quat[1]) + abs(g.quat[2]) < 1e-6 and g.contype]
    floor = level[0] if level else None
    scenery = [geom for geom in spec.worldbody.geoms if geom is not floor]
    notes = []
    if others or scenery:
        things = [body.name for body in others] + [geom.name or "a geom" for geom in scenery]
        notes.append(f"left out what does not belong to the robot: {listed(things)}")
    name = robots[0].name
    # Cameras and lights may follow removed bodies.
    for thing in [*others, *scenery, *spec.cameras, *spec.lights]:
        spec.delete(thing)
    return spec.body(name), notes


def _moves(body: mujoco.MjsBody) -> bool:
    return bool(body.joints) or any(_moves(child) for child in body.bodies)


def _is_free(body: mujoco.MjsBody) -> bool:
    return [joint.type for joint in body.joints] == [_FREE]


def free_root(spec: mujoco.MjSpec, root: mujoco.MjsBody) -> list[str]:
    """Give the root a free joint if it has none; return notes.

    The slides and hinges of a root with slides are removed, because they emulate a base that moves
    in a plane.

    Raises:
        ConfigError: a hinge or a ball joint connects the robot to the world.
    """
    if _is_free(root):
        return []
    joints = list(root.joints)
    names = listed([joint.name for joint in joints])
    if joints and all(joint.type != _SLIDE for joint in joints):
        raise ConfigError(
            f"{names} of body '{root.name}' connects the robot to the world; expected a free base:"
            " move the joint to a body below the base"
        )
    _remove_joints(spec, joints)
    root.add_freejoint(name=_free_name("root", {joint.name for joint in spec.joints}))
    instead = f" instead of {names}" if joints else ""
    return [f"base '{root.name}' got a free joint{instead}"]


def fix_slides(spec: mujoco.MjSpec) -> list[str]:
    """Remove slides, so that their bodies keep their places in the file; return notes."""
    slides = [joint for joint in spec.joints if joint.type == _SLIDE]
    names = [joint.name for joint in slides]
    _remove_joints(spec, slides)
    return [f"fixed slides: {listed(names)}"] if names else []


def _remove_joints(spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint]) -> None:
    """Remove joints with their actuators, constraints and tendons."""
    names = {joint.name for joint in joints}
    tendons = [
        tendon
        for tendon in spec.tendons
        if any(getattr(wrap.target, "name", "") in names for wrap in tendon.path)
    ]
    gone = names | {tendon.name for tendon in tendons}
    things = [a for a in spec.actuators if a.target in gone]
    for equality in spec.equalities:
        of_joints = equality.type == _EQUALITY.mjEQ_JOINT
        if equality.name1 in gone or (equality.name2 in gone and not of_joints):
            things.append(equality)
        elif equality.name2 in gone:
            equality.name2 = ""  # hold the follower of a removed leader
    for thing in [*things, *tendons, *joints]:
        spec.delete(thing)


def check_equalities(spec: mujoco.MjSpec) -> list[str]:
    """Remove inactive constraints and constraints that fix the robot to the world; return notes."""
    notes = []
    for equality in list(spec.equalities):
        names = [name for name in (equality.name1, equality.name2) if name]
        if equality.objtype == mujoco.mjtObj.mjOBJ_SITE:
            names = [spec.site(name).parent.name for name in names]
        names = [name for name in names if name != "world"]
        if not equality.active:
            spec.delete(equality)
        elif equality.type == _EQUALITY.mjEQ_JOINT:
            joint, other = equality.name1, equality.name2
            notes.append(f"joint '{joint}' follows '{other}'" if other else f"'{joint}' is held")
        elif equality.type == _EQUALITY.mjEQ_TENDON:
            notes.append(f"tendon '{names[0]}' is constrained")
        elif len(names) < 2:
            spec.delete(equality)
            notes.append(f"released '{names[0] if names else '?'}', which was fixed in the world")
    return notes


def check_numbers(model: mujoco.MjModel) -> None:
    """Refuse values that are NaN or too large for a robot, which MuJoCo would accept.

    Raises:
        ConfigError: a value is NaN or exceeds its limit.
    """
    rows = {"body": model.body, "geom": model.geom, "joint": model.joint}
    for field, (quantity, most, unit) in _LARGEST.items():
        values = np.atleast_2d(getattr(model, field).T).T
        largest = np.abs(values).max(axis=1, initial=0.0)
        prefix = field.partition("_")[0]
        kind = {"jnt": "joint", "dof": "joint"}.get(prefix, prefix)
        for row in np.flatnonzero(~(largest <= most)).tolist():  # NaN also fails this comparison
            owner = rows[kind](model.dof_jntid[row] if prefix == "dof" else row)
            raise ConfigError(
                f"{kind} '{printable(owner.name)}' has the {quantity} {largest[row]:.3g}"
                f" {unit}, expected at most {most:g} {unit}"
            )


def part_overlapping_bodies(
    spec: mujoco.MjSpec, model: mujoco.MjModel, qpos: npt.NDArray[np.float64]
) -> list[str]:
    """Exclude contacts of bodies that overlap in the start pose (Q,); return notes.

    MuJoCo uses the convex hulls of meshes, and a trunk's hull often contains the thighs. `model` is
    the compiled `spec`.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    found = {
        tuple(sorted(int(model.geom_bodyid[geom]) for geom in contact.geom))
        for contact in data.contact
        if contact.dist < -_OVERLAP
    }
    pairs = [(model.body(one).name, model.body(other).name) for one, other in sorted(found) if one]
    for one, other in pairs:
        spec.add_exclude(bodyname1=one, bodyname2=other)
    together = listed([f"{one} and {other}" for one, other in pairs])
    return [f"no contacts between bodies that overlap at the start: {together}"] if pairs else []


def add_contact_sensors(spec: mujoco.MjSpec) -> None:
    """Add a sensor `contact_<body>` for each body: the floor's net force (newton, world axes).

    Contacts between two bodies of the robot do not count, because they are frequent and are no
    falls.
    """
    for sensor in [s for s in spec.sensors if s.name.startswith(CONTACT_SENSOR_PREFIX)]:
        spec.delete(sensor)
    force, net_force = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3
    for body in spec.bodies[1:]:
        sensor = spec.add_sensor(name=f"{CONTACT_SENSOR_PREFIX}{body.name}", objname=body.name)
        sensor.type, sensor.objtype = mujoco.mjtSensor.mjSENS_CONTACT, mujoco.mjtObj.mjOBJ_BODY
        sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, "world"
        sensor.intprm[:3] = (force, net_force, 1)


_STAGE = "mjcf/parts/stage.xml"
_PREFIX = "stage/"
_MAX_ITERATIONS = 100
_ITERATIONS = ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations")
_COPIED_OF_FLOOR = ("pos", "quat", "size", "condim", "friction", "material", "group", "rgba")


def add_stage(spec: mujoco.MjSpec) -> None:
    """Add the floor, light and solver settings of this project's models.

    The cone, impratio and contact parameters of the robot stay. A floor in the file is reused. The
    floor is called `floor`, is at z = 0 and collides with every geom of the robot that can collide.
    """
    stage = mujoco.MjSpec.from_string(
        '<mujoco model="stage"><include file="stage.xml"/></mujoco>',
        include={"stage.xml": (assets_dir() / _STAGE).read_bytes()},
    )
    _take_options(spec, stage)
    _copy_fields(stage.visual, spec.visual)
    own = next(iter(spec.worldbody.geoms), None)
    bits = [(geom.contype, geom.conaffinity) for geom in spec.geoms]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo warns: no mesh files
        spec.attach(stage, frame=spec.worldbody.add_frame(), prefix=_PREFIX)
    floor = spec.geom(f"{_PREFIX}floor")
    if own is not None:
        for name in _COPIED_OF_FLOOR:
            setattr(own, name, getattr(floor, name))
        spec.delete(floor)
        for pair in spec.pairs:  # contact pairs use the old name of the floor
            pair.geomname1 = "floor" if pair.geomname1 == own.name else pair.geomname1
            pair.geomname2 = "floor" if pair.geomname2 == own.name else pair.geomname2
        floor = own
    floor.name = "floor"
    for contype, conaffinity in bits:
        floor.contype |= conaffinity
        floor.conaffinity |= contype


def _take_options(spec: mujoco.MjSpec, stage: mujoco.MjSpec) -> None:
    option = spec.option
    option.timestep, option.integrator = stage.option.timestep, stage.option.integrator
    option.solver = stage.option.solver
    option.disableflags, option.enableflags = stage.option.disableflags, stage.option.enableflags
    for name in _ITERATIONS:
        setattr(option, name, min(getattr(option, name), _MAX_ITERATIONS))


def _copy_fields(source: Any, target: Any) -> None:
    """Copy all values of a nested MuJoCo structure."""
    for name in (name for name in dir(source) if not name.startswith("_")):
        value = getattr(source, name)
        if isinstance(value, (int, float)):
            setattr(target, name, value)
        elif hasattr(value, "__len__"):
            getattr(target, name)[:] = value
        elif not callable(value):
            _copy_fields(value, getattr(target, name))
