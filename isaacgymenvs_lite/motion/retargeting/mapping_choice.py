"""Chooses mappings for retargeting from the user's argument or from the names of joints."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from isaacgymenvs_lite.errors import ConfigError, listed, unknown
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.bvh import (
    BvhMotion,
    bvh_hierarchy,
    chain,
    read_bvh,
    shared_chain,
)
from isaacgymenvs_lite.motion.retargeting.mapping import (
    AXES,
    WITH_ATTITUDE,
    BodySource,
    SkeletonMapping,
    axis_vector,
    body_frame,
    load_mapping,
    read_mapping_keys,
    shipped_mappings,
)
from isaacgymenvs_lite.motion.retargeting.robot_mapping import (
    RobotMapping,
    guess_robot_mapping,
    load_robot_mapping,
    names_body,
    shipped_robot_mappings,
)
from isaacgymenvs_lite.motion.retargeting.source import FEET, SIDES, leg_length, rotate
from isaacgymenvs_lite.utils import rotations

_FRAMES = [(x, z) for x, z in itertools.product(AXES, AXES) if x[1] != z[1]]
# Lengths of thigh plus shin of people who are 1.1 m and 2.2 m tall, and of an average adult.
_SHORTEST_LEG_M, _LONGEST_LEG_M, _USUAL_LEG_M = 0.45, 1.4, 0.85
_UNITS_M = (1.0, 0.01, 0.001, 0.0254, 0.056444, 0.1, 0.3048)  # length units of BVH files
_MAX_FRAMES = 1000
# The constants from `_STANDS` to `_FOOT_UP` are lower limits for cosines of angles.
_STANDS = 0.7  # between the direction from feet to head and the up axis
_STRAIGHT = 0.8  # between trunk and legs in a rest pose
_ALIGNED = 0.3  # between an axis of a joint and the axis of the joint's body
_FOOT_UP = -0.3  # between the up axes of ankle and foot, because feet tilt in crawls and dances
# The constants from `_BACKWARD` to `_GROUNDED` are measured in leg lengths.
_BACKWARD = 0.03  # If knees bend backward by more than this, left and right are exchanged.
_LOWEST_JOINT = 0.1  # height of the lowest joint above the ground
_PREFERRED = 0.15  # margin by which the mapping's up axis is preferred to another axis
_GROUNDED = 0.12  # limit for an up axis that is neither the mapping's nor the rest pose's


@dataclass(frozen=True, eq=False)
class _Skeleton:
    """Poses of the mapped joints in T frames, in the axes and the length unit of the file."""

    places: Mapping[str, FloatArray]  # from bodies to world positions (T, 3) of their joints
    turns: Mapping[str, FloatArray]  # from bodies to world rotations (T, 4) xyzw of their joints

    @classmethod
    def of(cls, motion: BvhMotion, mapping: SkeletonMapping, at_rest: bool = False) -> _Skeleton:
        """Return the skeleton in all frames of the motion, or in the rest pose (T = 1)."""
        every = slice(None, None, 1 + len(motion.turns) // _MAX_FRAMES)
        turns, root = motion.turns[every], motion.places[every]
        if at_rest:
            turns, root = np.zeros_like(turns[:1]), np.zeros((1, 3))
            turns[..., 3] = 1.0
        tree = (motion.parent_indices, motion.offsets)
        places, turns = kinematics.forward_kinematics(*tree, turns, root)
        joints = {body: source.joint for body, source in mapping.sources.items()}
        ids = {body: motion.joint_names.index(joint) for body, joint in joints.items()}
        return cls(
            {body: places[:, i] for body, i in ids.items()},
            {body: turns[:, i] for body, i in ids.items()},
        )

    @property
    def upward(self) -> FloatArray:
        """The unit vectors (T, 3) from the feet to the head."""
        return _unit(self.places["head"] - sum(self.places[foot] for foot in FEET) / 2)

    @property
    def left(self) -> FloatArray:
        """The unit vectors (T, 3) from the right hip to the left hip."""
        return _unit(self.places["left_thigh"] - self.places["right_thigh"])

    def axes_in_joint(self, body: str) -> tuple[FloatArray, FloatArray]:
        """Return a body's mean left and up directions (3,) in the axes of the body's joint."""
        place = self.places
        if body in FEET:
            thigh, shin = (
                place[body.replace("foot", below)] - place[body.replace("foot", above)]
                for above, below in (("thigh", "shin"), ("shin", "foot"))
            )
            # The left direction is the axis of the knee, or of the hips if the leg is straight.
            left, up = np.cross(_unit(thigh), _unit(shin)) + 0.1 * self.left, -shin
        else:
            shoulders = place["left_upper_arm"] - place["right_upper_arm"]
            left = self.left if body == "pelvis" else shoulders
            up = place["head"] - place["pelvis"]
        to_joint = rotations.quat_conjugate(torch.from_numpy(self.turns[body]))
        left, up = (rotations.quat_apply(to_joint, torch.from_numpy(way)) for way in (left, up))
        return _unit(left.mean(dim=0).numpy()), _unit(up.mean(dim=0).numpy())

    def knees_bend_backward(self) -> bool:
        """Return whether the knees bend backward because left and right are exchanged."""
        place = self.places
        forward = np.cross(self.left, place["head"] - place["pelvis"])
        bends = [
            place[f"{side}_shin"] - (place[f"{side}_thigh"] + place[f"{side}_foot"]) / 2
            for side in SIDES
        ]
        bend = float(np.mean([(way * _unit(forward)).sum(axis=1) for way in bends]))
        return bend < -_BACKWARD * leg_length(place)


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def check_fit(motion: BvhMotion, mapping: SkeletonMapping) -> None:
    """Raise a ConfigError with advice if a mapping does not fit the motion.

    The joint names, the up axis, the length unit, the axes of joints, and left and right are
    checked.
    """
    for body, source in mapping.sources.items():
        if source.joint not in motion.joint_names:
            problem = unknown("joint", source.joint, motion.joint_names)
            raise ConfigError(f"mapping={mapping.name}: bodies.{body}: {motion.name} has {problem}")
    with reading(motion.name, "BVH file"):
        if problems := _problems(motion, mapping):
            raise ConfigError(f"{motion.name} does not fit mapping={mapping.name}: {problems}")


def fitted(motion: BvhMotion, mapping: SkeletonMapping) -> SkeletonMapping:
    """Return the mapping with corrected up axis, length unit and joint axes for a motion."""
    with reading(motion.name, "BVH file"):
        skeleton, rest_axis = _Skeleton.of(motion, mapping), _rest_axis(motion, mapping)
        found = mapping
        if _wrong_axes(skeleton, mapping) and (sources := _sources_at_rest(motion, mapping)):
            at_rest = dataclasses.replace(mapping, up=rest_axis, sources=sources)
            found = mapping if _wrong_axes(skeleton, at_rest) else at_rest
        up = _up_axis(skeleton, rest_axis, found.up)
        unit_m = _unit_m(skeleton, mapping.unit_m) or mapping.unit_m
        found = dataclasses.replace(found, up=up, unit_m=unit_m)
        if problems := _problems(motion, found):
            raise ConfigError(
                f"{motion.name} does not fit the mapping {mapping.name}: {problems}; give "
                "mapping=FILE (docs/motion_formats.md)"
            )
        return found


def _problems(motion: BvhMotion, mapping: SkeletonMapping) -> str:
    """Describe the errors of a mapping and their corrections, or return "" if there are none."""
    skeleton, found = _Skeleton.of(motion, mapping), list[str]()
    unit_m = _unit_m(skeleton, mapping.unit_m)
    if unit_m != mapping.unit_m:
        leg_m = leg_length(skeleton.places) * mapping.unit_m
        usual = f"{_SHORTEST_LEG_M:g} to {_LONGEST_LEG_M:g}"
        size = f"its legs are {leg_m:.3g} m long, expected {usual}"
        if unit_m is None:
            return f"{size}: check unit_m"
        found.append(f"{size}: write unit_m: {unit_m:g}")
    up = _up_axis(skeleton, _rest_axis(motion, mapping), mapping.up)
    if up != mapping.up:
        found.append(f"its head is above its feet along {up}, not {mapping.up}: write up: {up}")
    if skeleton.knees_bend_backward():
        found.append("its knees bend backward: exchange the joints of left and right")
    elif axes := _wrong_axes(skeleton, mapping):
        found.append(f"axes of its joints are not forward (x) and up (z): write {axes}")
    return "; ".join(found)


def _up_axis(skeleton: _Skeleton, rest_axis: str, mapped: str) -> str:
    """Return the up axis of the file.

    The axis nearest to the mean direction from feet to head is returned if it equals the up axis of
    the mapping (`mapped`) or of the rest pose (`rest_axis`). If it equals neither, the body may
    lie, crawl or stand on its hands. Then the function returns the axis along which the lowest
    joint stays at the height of the ground.
    """
    stands = _nearest_axis(skeleton.upward.mean(axis=0), _STANDS)
    if stands and stands in (mapped, rest_axis):
        return stands
    leg = leg_length(skeleton.places)

    def cost(axis: str) -> float:
        heights = np.stack(list(skeleton.places.values())) @ axis_vector(axis) / leg
        lowest = heights.min(axis=0)
        off = float(lowest.std()) + abs(float(np.median(lowest)) - _LOWEST_JOINT)
        if off > _GROUNDED and axis not in (mapped, stands, rest_axis):
            return np.inf
        return off - _PREFERRED * (axis == mapped)

    return min(AXES, key=cost)


def _nearest_axis(vector: FloatArray, least: float) -> str:
    """Return the axis nearest to a vector (3,), or "" if all components are below `least`."""
    axis = max(AXES, key=lambda name: float(axis_vector(name) @ vector))
    return axis if axis_vector(axis) @ vector >= least else ""


def _rest_axis(motion: BvhMotion, mapping: SkeletonMapping) -> str:
    """Return the axis from feet to head in the rest pose, or "" if that pose is not upright."""
    rest = _Skeleton.of(motion, mapping, at_rest=True)
    pelvis, head = (rest.places[body][0] for body in ("pelvis", "head"))
    legs = pelvis - sum(rest.places[foot][0] for foot in FEET) / 2
    straight = float(_unit(head - pelvis) @ _unit(legs))
    return _nearest_axis(rest.upward[0], _STRAIGHT) if straight >= _STRAIGHT else ""


def _sources_at_rest(motion: BvhMotion, mapping: SkeletonMapping) -> dict[str, BodySource]:
    """Return the body sources with joint axes from the rest pose, or {} if it is not upright.

    If the legs are spread in the rest pose, the feet are corrected by the tilt of the shins.
    """
    rest = _Skeleton.of(motion, mapping, at_rest=True)
    z, y = _rest_axis(motion, mapping), _nearest_axis(rest.left[0], _STRAIGHT)
    if not z or not y or y[1] == z[1]:
        return {}
    x = _nearest_axis(np.cross(axis_vector(y), axis_vector(z)), _STRAIGHT)
    sources = {}
    for body, source in mapping.sources.items():
        tilt_deg = 0.0
        if body in FEET:
            shin = rest.places[body.replace("foot", "shin")][0] - rest.places[body][0]
            tilt_deg = np.degrees(np.arctan2(-shin @ axis_vector(y), shin @ axis_vector(z)))
        frame = body_frame(x, z, (tilt_deg, 0.0, 0.0)) if body in WITH_ATTITUDE else None
        sources[body] = BodySource(source.joint, frame, body in FEET)
    return sources


def _unit_m(skeleton: _Skeleton, mapped: float) -> float | None:
    """Return a unit of length (m) with which the legs have a human length, or None.

    The mapping's unit is preferred to the frequent units of BVH files.
    """
    leg = leg_length(skeleton.places)
    units = [u for u in (mapped, *_UNITS_M) if _SHORTEST_LEG_M <= leg * u <= _LONGEST_LEG_M]
    if mapped in units:
        return mapped
    return min(units, key=lambda unit: abs(np.log(leg * unit / _USUAL_LEG_M)), default=None)


def _wrong_axes(skeleton: _Skeleton, mapping: SkeletonMapping) -> str:
    """Return, as text, the mapping entries of bodies whose axes must be corrected."""
    return ", ".join(
        f"{body}: {{joint: {mapping.sources[body].joint}, x: {axes[0]}, z: {axes[1]}}}"
        for body in WITH_ATTITUDE
        if (axes := _better_axes(skeleton, body, mapping.sources[body].frame))
    )


def _better_axes(
    skeleton: _Skeleton, body: str, frame: FloatArray | None
) -> tuple[str, str] | None:
    """Return better forward and up axes of a body's joint, or None if `frame` (4,) fits."""
    left, up = skeleton.axes_in_joint(body)

    def parts(frame: FloatArray) -> tuple[float, float]:
        y, z = (rotate(frame[None], axis_vector(axis))[0] for axis in ("+y", "+z"))
        return float(y @ left), float(z @ up)

    to_left, to_up = (0.0, 0.0) if frame is None else parts(frame)
    if to_left > _ALIGNED and to_up > (_FOOT_UP if body in FEET else _ALIGNED):
        return None
    return max(_FRAMES, key=lambda axes: sum(parts(body_frame(*axes))))


_log = logging.getLogger(__name__)

# Joints that identify the skeletons of the shipped mappings. LAFAN1's skeleton has all joints of
# CMU's mapping, but the axes of the joints differ.
_MARKS = {
    "cmu": {"LHipJoint", "RHipJoint", "LowerBack"},
    "lafan1": {"Spine2", "LeftToe", "RightToe"},
}

_HELPER = re.compile("twist|roll", re.IGNORECASE)


def read_named_mappings(mapping: str) -> tuple[SkeletonMapping | None, RobotMapping | None]:
    """Read the user's mapping for the skeleton of a BVH file, for a robot, or for both.

    `mapping` is the name of a shipped mapping or a YAML file, or two such values separated by a
    comma. The keys of a file show whether it is a mapping for a skeleton or for a robot.
    """
    skeleton: SkeletonMapping | None = None
    robot: RobotMapping | None = None
    for name in filter(None, map(str.strip, mapping.split(","))):
        _, keys = read_mapping_keys(name, shipped_mappings() | shipped_robot_mappings(), "bodies")
        bodies = keys.get("bodies")
        entries = bodies.values() if isinstance(bodies, Mapping) else ()
        joints = any(isinstance(entry, Mapping) and "joint" in entry for entry in entries)
        is_robots = not ("up" in keys or "unit_m" in keys or joints)
        if (robot if is_robots else skeleton) is not None:
            kind = "a robot" if is_robots else "a BVH file's skeleton"
            raise ConfigError(
                f"mapping={mapping}: has two mappings of {kind}, expected at most one of a BVH "
                f"file's skeleton ({', '.join(shipped_mappings())}, a file) and one of a robot "
                f"({', '.join(shipped_robot_mappings())}, a file)"
            )
        if is_robots:
            robot = load_robot_mapping(name)
        else:
            skeleton = load_mapping(name)
    return skeleton, robot


def recognise_skeleton(path: str | Path) -> SkeletonMapping:
    """Find, log and return a mapping for the joints of a BVH file.

    A shipped mapping with these joints is preferred; otherwise a mapping is guessed from the names
    of feet, hands and head. `fitted` corrects the mapping. Raises ConfigError if no mapping fits.
    """
    names, parents = bvh_hierarchy(path)
    for name, marks in _MARKS.items():
        mapping = load_mapping(name)
        used = {source.joint for source in mapping.sources.values()}
        if set(names) >= marks | used:
            found = fitted(read_bvh(path, used), mapping)
            _log.info(
                "%s: has the joints of mapping=%s, which is used with up: %s, unit_m: %g and %s",
                *(path, name, found.up, found.unit_m),
                "its x and z" if found.sources is mapping.sources else "x and z of the rest pose",
            )
            return found
    joints = _guess_joints(names, parents)
    if not joints:
        raise ConfigError(
            f"{path}: has the joints of no shipped mapping ({listed(names)}); give mapping=, one "
            f"of {', '.join(shipped_mappings())} or a YAML file (docs/motion_formats.md)"
        )
    sources = {body: BodySource(joint, None, False) for body, joint in joints.items()}
    guess = SkeletonMapping("guessed by names", "+y", 0.01, sources)
    found = fitted(read_bvh(path, joints.values()), guess)
    _log.info(
        "%s: joints by name: %s; up: %s, unit_m: %g, x and z as in its rest pose; a mapping file "
        "changes it (docs/motion_formats.md)",
        path,
        ", ".join(f"{body}: {joint}" for body, joint in joints.items()),
        found.up,
        found.unit_m,
    )
    return found


def _guess_joints(names: Sequence[str], parents: Sequence[int]) -> dict[str, str]:
    """Guess each body's joint from the names of feet, hands and head, or return {} on failure.

    A limb consists of a foot or hand and the two joints above it; twist helper joints are skipped.
    The pelvis is the lowest joint above both legs, and the torso the lowest joint above both arms.
    Joints named ankle and wrist are preferred to joints named foot and hand, which may be toes and
    fingers.
    """
    found: dict[str, int] = {}
    for side in SIDES:
        for patterns, bodies in (
            (("ankle", "foot"), ("thigh", "shin", "foot")),
            (("wrist", "hand"), ("upper_arm", "lower_arm", "hand")),
        ):
            end = _first_named(names, patterns, side)
            limb = chain(parents, end) if end is not None else []
            limb = [i for i in limb if not _HELPER.search(names[i]) or i == end]
            found |= zip([f"{side}_{body}" for body in bodies], limb[-3:], strict=False)
    head = _first_named(names, ("head", "neck"), "")
    if head is None or len(found) != 12:
        return {}
    for body, limb in (("pelvis", "thigh"), ("torso", "upper_arm")):
        found[body] = shared_chain(parents, [found[f"{side}_{limb}"] for side in SIDES])[-1]
    found["head"] = head
    return {body: names[i] for body, i in found.items()}


def _first_named(names: Sequence[str], patterns: Sequence[str], side: str) -> int | None:
    """Return the first joint that matches the first pattern with a match, or None."""
    fitting = (
        i for pattern in patterns for i, name in enumerate(names) if names_body(name, pattern, side)
    )
    return next(fitting, None)


def recognise_robot(model: mujoco.MjModel, start: FloatArray) -> RobotMapping:
    """Return and log the shipped mapping for the bodies of a robot, or a guessed mapping.

    The robot stands in the pose `start` (nq,). Raises ConfigError like `guess_robot_mapping`.
    """
    bodies = {model.body(i).name for i in range(model.nbody)}
    for name in shipped_robot_mappings():
        mapping = load_robot_mapping(name)
        if bodies >= {entry.body for entry in mapping.bodies.values()}:
            _log.info("the robot has the bodies of mapping=%s, which is used", name)
            return mapping
    mapping, line = guess_robot_mapping(model, start)
    _log.info("%s; a mapping file changes it (docs/motion_formats.md)", line)
    return mapping
