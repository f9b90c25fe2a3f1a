"""Compares a mapping with the skeleton of a BVH file as it moves: up axis, unit, axes of joints."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.bvh import BvhMotion
from isaacgymenvs_lite.motion.retargeting.mapping import (
    AXES,
    WITH_ATTITUDE,
    BodySource,
    SkeletonMapping,
    axis_vector,
    body_frame,
)
from isaacgymenvs_lite.motion.retargeting.source import FEET, SIDES, leg_length, rotate
from isaacgymenvs_lite.utils import rotations

_FRAMES = [(x, z) for x, z in itertools.product(AXES, AXES) if x[1] != z[1]]
# Thigh and shin of people between 1.1 m and 2.2 m; the mean of adults. Units of BVH files in m.
_SHORTEST_LEG_M, _LONGEST_LEG_M, _USUAL_LEG_M = 0.45, 1.4, 0.85
_UNITS_M = (1.0, 0.01, 0.001, 0.0254, 0.056444, 0.1, 0.3048)
_MAX_FRAMES = 1000
# Least cosines: an upright skeleton and an axis; trunk and legs at rest; a joint's axis and its
# body's; the same for a foot's up axis, which tilts in crawls and dances.
_STANDS, _STRAIGHT, _ALIGNED, _FOOT_UP = 0.7, 0.8, 0.3, -0.3
# Knees that bend backward by this share of a leg's length on average are no knees.
_BACKWARD = 0.03
# In leg lengths: the expected height of the lowest joint; how much more deviation from it is
# accepted for the mapping's axis; the largest deviation for an axis that neither mapping nor pose
# suggests.
_LOWEST_JOINT, _PREFERRED, _GROUNDED = 0.1, 0.15, 0.12


@dataclass(frozen=True, eq=False)
class _Skeleton:
    """A mapped skeleton in T frames of its motion, in the axes and the unit of the file.

    Attributes:
        places: (T, 3) of each body's joint.
        turns: (T, 4) xyzw, attitude of each body's joint.
    """

    places: Mapping[str, FloatArray]
    turns: Mapping[str, FloatArray]

    @classmethod
    def of(cls, motion: BvhMotion, mapping: SkeletonMapping, at_rest: bool = False) -> _Skeleton:
        """Return the skeleton in the frames of the motion, or in its rest pose, T = 1."""
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
        """(T, 3) directions from the feet to the head."""
        return _unit(self.places["head"] - sum(self.places[foot] for foot in FEET) / 2)

    @property
    def left(self) -> FloatArray:
        """(T, 3) directions from the right hip to the left one."""
        return _unit(self.places["left_thigh"] - self.places["right_thigh"])

    def axes_in_joint(self, body: str) -> tuple[FloatArray, FloatArray]:
        """Return the mean directions (3,) left and up of a body, in the axes of its joint."""
        place = self.places
        if body in FEET:
            thigh, shin = (
                place[body.replace("foot", below)] - place[body.replace("foot", above)]
                for above, below in (("thigh", "shin"), ("shin", "foot"))
            )
            # The axis of the knee; a straight leg has none, then the axis of the hips counts.
            left, up = np.cross(_unit(thigh), _unit(shin)) + 0.1 * self.left, -shin
        else:
            shoulders = place["left_upper_arm"] - place["right_upper_arm"]
            left = self.left if body == "pelvis" else shoulders
            up = place["head"] - place["pelvis"]
        to_joint = rotations.quat_conjugate(torch.from_numpy(self.turns[body]))
        left, up = (rotations.quat_apply(to_joint, torch.from_numpy(way)) for way in (left, up))
        return _unit(left.mean(dim=0).numpy()), _unit(up.mean(dim=0).numpy())

    def knees_bend_backward(self) -> bool:
        """Return whether the knees bend backward, as in a mirror image of a figure."""
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
    """Check a mapping by the skeleton as it moves.

    Raises:
        ConfigError: another axis of the file is up, its unit is another one, the joints have other
            axes, or left and right are exchanged; the line has what to write.
    """
    mapping.check_joints(motion.joint_names, motion.name)
    with reading(motion.name, "BVH file"):
        if problems := _problems(motion, mapping):
            raise ConfigError(f"{motion.name} does not fit mapping={mapping.name}: {problems}")


def fitted(motion: BvhMotion, mapping: SkeletonMapping) -> SkeletonMapping:
    """Return a mapping with the up axis, the unit and the axes of joints that the skeleton shows.

    Raises:
        ConfigError: a mapping that fits cannot be found; the line has what to write.
    """
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
    """Return what does not fit, and what to write; "" if all fits."""
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
    """Return the axis of the file that points up.

    It is the axis along which the body stands on average, if the mapping (`mapped`) or the rest
    pose (`rest_axis`) has the same axis. Bodies also lie, crawl and stand on their hands; then it
    is the axis along which the lowest joint stays at the height of the ground.
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
    """Return the axis nearest to a vector (3,) whose part along it is `least` or more, or ""."""
    axis = max(AXES, key=lambda name: float(axis_vector(name) @ vector))
    return axis if axis_vector(axis) @ vector >= least else ""


def _rest_axis(motion: BvhMotion, mapping: SkeletonMapping) -> str:
    """Return the axis from the feet to the head in the rest pose; "" if it does not stand."""
    rest = _Skeleton.of(motion, mapping, at_rest=True)
    pelvis, head = (rest.places[body][0] for body in ("pelvis", "head"))
    legs = pelvis - sum(rest.places[foot][0] for foot in FEET) / 2
    straight = float(_unit(head - pelvis) @ _unit(legs))
    return _nearest_axis(rest.upward[0], _STRAIGHT) if straight >= _STRAIGHT else ""


def _sources_at_rest(motion: BvhMotion, mapping: SkeletonMapping) -> dict[str, BodySource]:
    """Return the sources with axes of joints as in the rest pose; {} if it does not stand.

    The feet of a rest pose with spread legs are on edge, and turned with the shins.
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
    """Return the mapping's unit if the legs are a human's with it, else a usual one, or None."""
    leg = leg_length(skeleton.places)
    units = [u for u in (mapped, *_UNITS_M) if _SHORTEST_LEG_M <= leg * u <= _LONGEST_LEG_M]
    if mapped in units:
        return mapped
    return min(units, key=lambda unit: abs(np.log(leg * unit / _USUAL_LEG_M)), default=None)


def _wrong_axes(skeleton: _Skeleton, mapping: SkeletonMapping) -> str:
    """Return what to write for bodies whose axes in the mapping are not forward and up, else ""."""
    return ", ".join(
        f"{body}: {{joint: {mapping.sources[body].joint}, x: {axes[0]}, z: {axes[1]}}}"
        for body in WITH_ATTITUDE
        if (axes := _better_axes(skeleton, body, mapping.sources[body].frame))
    )


def _better_axes(
    skeleton: _Skeleton, body: str, frame: FloatArray | None
) -> tuple[str, str] | None:
    """Return better axes forward and up for a body's joint than `frame` (4,); None if it fits."""
    left, up = skeleton.axes_in_joint(body)

    def parts(frame: FloatArray) -> tuple[float, float]:
        y, z = (rotate(frame[None], axis_vector(axis))[0] for axis in ("+y", "+z"))
        return float(y @ left), float(z @ up)

    to_left, to_up = (0.0, 0.0) if frame is None else parts(frame)
    if to_left > _ALIGNED and to_up > (_FOOT_UP if body in FEET else _ALIGNED):
        return None
    return max(_FRAMES, key=lambda axes: sum(parts(body_frame(*axes))))
