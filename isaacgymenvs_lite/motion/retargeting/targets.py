"""Target poses of the humanoid's bodies: the source's motion, scaled limb by limb."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.mapping import SkeletonMapping
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations

_log = logging.getLogger(__name__)

SIDES = ("right", "left")
# Bodies that are placed in the source's direction from their parent, at the humanoid's distance.
_LIMBS = ("lower_arm", "hand", "shin")
# A foot is on the ground while its joint is slower than this and near its lowest height.
_CONTACT_SPEED = 0.2  # m/s
_CONTACT_HEIGHT_M = 0.01
_FEWEST_CONTACT_FRAMES = 5
_SHORTEST_LEG_M, _LONGEST_LEG_M = 0.05, 10.0
# A larger tilt of the sole is no difference between rigs but part of the motion.
_MOST_LEVELLING_RAD = np.radians(15.0)
# The ground is at the lowest corner of a sole, hand or knee, except in this share of the frames
# (noise).
_BELOW_GROUND_SHARE = 0.02
# Radii of the humanoid's hands and, about the origin of the shin, knees.
_ROUND_M = {"right_hand": 0.04, "left_hand": 0.04, "right_shin": 0.05, "left_shin": 0.05}


@dataclass(frozen=True, eq=False)
class Targets:
    """T poses for J bodies, in the world.

    Attributes:
        positions: (T, J, 3) m, of the bodies' origins. Limbs have the humanoid's lengths and the
            source's directions; pelvis and feet are scaled by the length of the legs.
        turns: (T, 4) xyzw, attitudes of the bodies that follow the source's, by name.
        scale: the humanoid's leg length divided by the source's.
    """

    positions: FloatArray
    turns: dict[str, FloatArray]
    scale: float


def make_targets(source: MotionClip, mapping: SkeletonMapping, skeleton: Skeleton) -> Targets:
    """Return the targets of a source motion in m, z up.

    Raises:
        ConfigError: the source lacks a joint of the mapping.
        MotionFileError: its legs are too short or too long to be legs.
    """
    mapping.check_joints(source.body_names, source.name)
    everywhere, attitudes = source.global_poses()
    index = {body: source.body_names.index(s.joint) for body, s in mapping.sources.items()}
    places = {body: everywhere[:, joint] for body, joint in index.items()}
    turns = {
        body: _rotated_in_body(attitudes[:, index[body]], entry.frame)
        for body, entry in mapping.sources.items()
        if entry.frame is not None
    }
    leg_m = _leg_length(places)
    if not _SHORTEST_LEG_M <= leg_m <= _LONGEST_LEG_M:
        raise MotionFileError(
            f"{source.name}: its legs are {leg_m:.3g} m long with mapping={mapping.name}, expected "
            f"{_SHORTEST_LEG_M:g} to {_LONGEST_LEG_M:g}; check unit_m of the mapping"
        )
    scale = _leg_length(_rest_places(skeleton)) / leg_m
    scaled = {body: place * scale for body, place in places.items()}
    feet = [f"{side}_foot" for side in SIDES]
    for foot in feet:
        if mapping.sources[foot].level:
            turns[foot] = _levelled(turns[foot], scaled[foot], source.fps, foot)
    target = {foot: scaled[foot] for foot in feet}
    target["pelvis"] = 0.5 * (scaled["right_thigh"] + scaled["left_thigh"])
    _add_other_bodies(target, skeleton, places, turns)
    soles = {foot: _sole_height(skeleton, foot, turns[foot]) + target[foot][:, 2] for foot in feet}
    lowest = [target[body][:, 2] - radius for body, radius in _ROUND_M.items()]
    ground = float(np.quantile(np.min([*soles.values(), *lowest], axis=0), _BELOW_GROUND_SHARE))
    positions = np.stack([target[body] for body in skeleton.body_names], axis=1)
    positions[..., 2] -= ground
    for foot in feet:
        # Not below the ground, whatever the noise.
        deep = np.maximum(ground - soles[foot], 0.0)
        positions[:, skeleton.body_names.index(foot), 2] += deep
    return Targets(positions, turns, scale)


def _add_other_bodies(
    target: dict[str, FloatArray],
    skeleton: Skeleton,
    places: dict[str, FloatArray],
    turns: dict[str, FloatArray],
) -> None:
    """Place trunk and limbs from the pelvis outwards; without a source, at the parent's place.

    Sword and shield are no targets; they have the places of the hands.
    """
    for i, body in enumerate(skeleton.body_names):
        if body in target:
            continue
        parent = skeleton.body_names[skeleton.parent_indices[i]]
        offset = skeleton.local_translation[i]
        if body.partition("_")[2] in _LIMBS:
            way = places[body] - places[parent]
            length = np.linalg.norm(way, axis=1, keepdims=True)
            step = way / np.maximum(length, 1e-9) * np.linalg.norm(offset)
        elif parent in turns and body in places:
            step = _rotate(turns[parent], offset)
        else:
            step = np.zeros(3)
        target[body] = target[parent] + step


def _rest_places(skeleton: Skeleton) -> dict[str, FloatArray]:
    """Return the places (1, 3) m of the bodies in the zero pose."""
    places: dict[str, FloatArray] = {}
    for body, parent, offset in zip(
        skeleton.body_names, skeleton.parent_indices, skeleton.local_translation, strict=True
    ):
        base = places[skeleton.body_names[parent]] if parent >= 0 else 0.0
        places[body] = base + offset[None]
    return places


def _leg_length(places: dict[str, FloatArray]) -> float:
    """Return the length in m of thigh and shin, the mean of both legs and all frames."""
    total = 0.0
    for side in SIDES:
        for upper, lower in (("thigh", "shin"), ("shin", "foot")):
            way = places[f"{side}_{upper}"] - places[f"{side}_{lower}"]
            total += float(np.linalg.norm(way, axis=1).mean())
    return total / len(SIDES)


def _levelled(turns: FloatArray, places: FloatArray, fps: float, foot: str) -> FloatArray:
    """Return the attitudes (T, 4) of a foot, rotated so that its sole is flat while on the ground.

    Rigs differ in the frame of a foot. The median over the frames on the ground gives its direction
    up.
    """
    speed = np.linalg.norm(np.gradient(places, axis=0), axis=1) * fps
    low = places[:, 2] < np.quantile(places[:, 2], 0.05) + _CONTACT_HEIGHT_M
    on_ground = low & (speed < _CONTACT_SPEED)
    if np.count_nonzero(on_ground) < _FEWEST_CONTACT_FRAMES:
        _log.info("%s: never on the ground; the mapping alone gives the attitude of its sole", foot)
        return turns
    upright = np.tile((0.0, 0.0, 1.0), (int(on_ground.sum()), 1))
    inverse = rotations.quat_conjugate(torch.from_numpy(turns[on_ground]))
    up = np.median(rotations.quat_apply(inverse, torch.from_numpy(upright)).numpy(), axis=0)
    up /= np.linalg.norm(up)
    axis = torch.from_numpy(np.cross((0.0, 0.0, 1.0), up))
    angle = torch.atan2(axis.norm(), torch.tensor(up[2]))
    if angle > _MOST_LEVELLING_RAD:
        _log.info(
            "%s: never flat on the ground; the mapping alone gives the attitude of its sole", foot
        )
        return turns
    _log.info("%s: sole levelled by %.1f deg", foot, float(torch.rad2deg(angle)))
    return _rotated_in_body(turns, rotations.quat_from_angle_axis(angle, axis).numpy())


def _sole_height(skeleton: Skeleton, foot: str, turns: FloatArray) -> FloatArray:
    """Return the height (T) in m of the lowest corner of a foot over the foot's origin."""
    body = skeleton.body_names.index(foot)
    corners = skeleton.foot_corners[[owner == body for owner in skeleton.foot_body_ids]]
    return np.min([_rotate(turns, corner)[:, 2] for corner in corners], axis=0)


def _rotated_in_body(turns: FloatArray, frame: FloatArray) -> FloatArray:
    """Return rotations (T, 4) after the rotation `frame` (4,) in the body's own axes."""
    q = torch.from_numpy(turns)
    return rotations.quat_mul(q, torch.from_numpy(frame).expand_as(q)).numpy()


def _rotate(turns: FloatArray, vector: FloatArray) -> FloatArray:
    """Return a vector (3,) rotated by each of (T, 4)."""
    q = torch.from_numpy(turns)
    return rotations.quat_apply(q, torch.from_numpy(vector).expand(len(q), 3)).numpy()
