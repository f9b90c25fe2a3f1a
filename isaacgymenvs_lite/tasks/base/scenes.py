"""Builds the scene of an arm or a hand in an MjSpec: the robot of a file, furniture and objects.

The robot's file may be this project's own, or a user's file, for example from MuJoCo's menagerie. A
task lists the published name of each joint and body, and then the names in other files. The
published drives replace the actuators, tendons and equality constraints of the file.

Collision bits: the links of an arm do not collide with each other, and neither does furniture. A
hand collides with objects and, with `HAND_BITS`, with itself. Objects collide with everything.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.robots.drives import add_actuator
from isaacgymenvs_lite.robots.structure import add_stage

Bits = tuple[int, int]
"""The contype and the conaffinity of geoms."""
ARM_BITS: Bits = (2, 5)
FURNITURE_BITS: Bits = (4, 2)
HAND_BITS: Bits = (4, 4)
HAND_WITHOUT_SELF_CONTACT_BITS: Bits = (4, 0)
OBJECT_BITS: Bits = (1, 5)
OBJECT_PRIORITY = 1
"""MuJoCo takes the friction of the geom with the higher priority. For equal priorities it takes the
larger friction, and a random friction below the hand's friction would have no effect."""
ORANGE = (0.85, 0.49, 0.26, 1.0)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)

_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "r": (0, 0, 1)}

Names = tuple[str, ...]
"""The names of a joint or body: the published name, then the names in files of other makers."""


@dataclass(frozen=True)
class PositionDrive:
    """A position drive: stiffness (Nm/rad or N/m), damping (Nm s/rad) and largest force (Nm, N)."""

    stiffness: float
    damping: float
    effort: float


def find_body(spec: mujoco.MjSpec, names: Names) -> mujoco.MjsBody:
    """Return the body that has one of these names; raise ConfigError if there is none."""
    return _find(spec.bodies, names, "body")


def find_joint(spec: mujoco.MjSpec, names: Names) -> mujoco.MjsJoint:
    """Return the joint that has one of these names; raise ConfigError if there is none."""
    return _find(spec.joints, names, "joint")


def _find(elements: Sequence[mujoco.MjsElement], names: Names, what: str) -> mujoco.MjsElement:
    by_name = {element.name: element for element in elements}
    for name in names:
        if name in by_name:
            return by_name[name]
    raise ConfigError(
        f"task.env.asset: the model has no {what} '{names[0]}'"
        f"{''.join(f' or {name!r}' for name in names[1:])};"
        f" it has {', '.join(name for name in by_name if name)}"
    )


def ensure_frame(
    spec: mujoco.MjSpec,
    names: Names,
    parent: mujoco.MjsBody,
    pos: Sequence[float],
    quat_wxyz: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
) -> mujoco.MjsBody:
    """Return the body that has one of these names, or add a massless body at a pose (m, wxyz)."""
    for body in spec.bodies:
        if body.name in names:
            return body
    return parent.add_body(name=names[0], pos=pos, quat=quat_wxyz)


def prepare_robot(spec: mujoco.MjSpec, root: mujoco.MjsBody, bits: Bits) -> None:
    """Remove the file's controls, compensate the robot's weight, set its bits, and add a stage.

    `root` is the robot's first body.
    """
    remove_controls(spec)
    if spec.geom("floor") is None:
        add_stage(spec)
    for body in subtree(root):
        body.gravcomp = 1.0
        set_bits(body.geoms, bits)


def remove_controls(spec: mujoco.MjSpec) -> None:
    """Remove actuators, tendons, equality constraints, sensors and keys."""
    for thing in (*spec.actuators, *spec.tendons, *spec.equalities, *spec.sensors, *spec.keys):
        spec.delete(thing)


def align_root(
    spec: mujoco.MjSpec,
    root: mujoco.MjsBody,
    own: mujoco.MjSpec,
    pairs: Iterable[tuple[mujoco.MjsJoint, mujoco.MjsJoint]],
) -> None:
    """Move a robot so that its joints are as near as possible to those of this project's model.

    The frames of two models of a robot may differ, so the places of their joints in the reference
    poses are compared (Kabsch 1976). The pairs contain a joint of `spec` and its counterpart in
    `own`, and the joints of a model must not be on a line.
    """
    joints, counterparts = zip(*pairs, strict=True)
    mine, theirs = _anchors_w(spec, joints), _anchors_w(own, counterparts)
    centre, target = mine.mean(axis=0), theirs.mean(axis=0)
    left, _, right = np.linalg.svd((theirs - target).T @ (mine - centre))
    flips = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    rotation = left @ flips @ right
    quat, old = np.empty(4), np.array(root.quat)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    new = np.empty(4)
    mujoco.mju_mulQuat(new, quat, old)
    root.pos = rotation @ (np.array(root.pos) - centre) + target
    root.quat = new


def _anchors_w(spec: mujoco.MjSpec, joints: Iterable[mujoco.MjsJoint]) -> npt.NDArray[np.float64]:
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.stack([data.xanchor[model.joint(joint.name).id] for joint in joints])


def subtree(body: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    """Return a body and all bodies below it."""
    return [body, *(below for child in body.bodies for below in subtree(child))]


def topmost(body: mujoco.MjsBody) -> mujoco.MjsBody:
    """Return the ancestor of a body that is a child of the world."""
    while body.parent.name != "world":
        body = body.parent
    return body


def set_bits(geoms: Iterable[mujoco.MjsGeom], bits: Bits) -> None:
    """Set the contype and conaffinity of the geoms that can collide at all."""
    for geom in geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = bits


def add_position_drive(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, drive: PositionDrive) -> None:
    """Add a position actuator. The damping and armature of the joint stay as they are."""
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    add_actuator(spec, joint.name, drive.stiffness, drive.damping, drive.effort)


def limit_speed(joint: mujoco.MjsJoint, effort: float, speed: float) -> None:
    """Give a joint a drag that equals its largest torque (Nm) at its largest speed (rad/s).

    PhysX limits the speeds of joints, MuJoCo does not. The drag grows with the third power of the
    speed, so that it is small at low speeds. It replaces the damping of the joint.
    """
    joint.damping[:] = (0.0, 0.0, effort / speed**3)


def add_motor(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, effort: float) -> None:
    """Add an actuator whose control is a torque (Nm) or force (newton) of at most `effort`."""
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    add_actuator(spec, joint.name, kp=0.0, kd=0.0, effort=effort).gainprm[0] = 1.0


def add_placing_joints(body: mujoco.MjsBody, axes: str) -> tuple[str, ...]:
    """Let each environment place a fixed body elsewhere; return the names of the joints.

    The letters of `axes` are x, y and z for slides (m) and r for a rotation about z (rad). The
    joints are too heavy and too slow to move in an episode, and stay at the values that are
    written.
    """
    names = []
    for axis in axes:
        joint = body.add_joint(name=f"{body.name}_{axis}", axis=_AXES[axis])
        is_slide = axis != "r"
        joint.type = mujoco.mjtJoint.mjJNT_SLIDE if is_slide else mujoco.mjtJoint.mjJNT_HINGE
        joint.armature = 1e4
        joint.damping[:] = (1e7, 0.0, 0.0)
        names.append(joint.name)
    for below in subtree(body):
        below.gravcomp = 1.0
    return tuple(names)


def add_furniture(
    spec: mujoco.MjSpec,
    name: str,
    size_m: Sequence[float],
    pos: Sequence[float],
    rgba: Sequence[float],
) -> None:
    """Add a fixed box with edges `size_m` (3,) m."""
    body = spec.worldbody.add_body(name=name, pos=pos)
    _add_geom(body, _BOX, [0.5 * edge for edge in size_m], FURNITURE_BITS, rgba=rgba)


def add_object(
    spec: mujoco.MjSpec,
    name: str,
    size_m: Sequence[float],
    pos: Sequence[float],
    density: float,
    kind: int = _BOX,
    rgba: Sequence[float] = ORANGE,
) -> None:
    """Add a free body with one geom; type and sizes (m) are MuJoCo's, the density is in kg/m^3."""
    body = spec.worldbody.add_body(name=name, pos=pos)
    body.add_freejoint(name=name)
    fields = {"rgba": rgba, "density": density, "priority": OBJECT_PRIORITY}
    _add_geom(body, kind, size_m, OBJECT_BITS, **fields)


def _add_geom(
    body: mujoco.MjsBody, kind: int, size_m: Sequence[float], bits: Bits, **fields: Any
) -> None:
    contype, conaffinity = bits
    own = {"contype": contype, "conaffinity": conaffinity, "condim": 4}
    body.add_geom(name=body.name, type=kind, size=size_m, **own, **fields)
