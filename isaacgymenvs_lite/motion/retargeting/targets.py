"""Target poses of a figure's bodies: the source's motion, scaled limb by limb."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.contacts import (
    CONTACT_LOW_M,
    Flags,
    find_contacts,
    pin_feet,
)
from isaacgymenvs_lite.motion.retargeting.figure import Figure
from isaacgymenvs_lite.motion.retargeting.source import (
    FEET,
    SourceMotion,
    leg_length,
    rotate,
    rotated_in_body,
)
from isaacgymenvs_lite.utils import rotations

_log = logging.getLogger(__name__)

# Bodies that are placed in the source's direction from their parent, at the figure's distance.
_LIMBS = ("lower_arm", "hand", "shin")
# A foot is on the ground while its joint is slower than this and near its lowest height.
_CONTACT_SPEED = 0.2  # m/s
_CONTACT_HEIGHT_M = 0.01
_FEWEST_CONTACT_FRAMES = 5
# A larger tilt of the sole is no difference between rigs but part of the motion.
_MOST_LEVELLING_RAD = np.radians(15.0)
# The ground is at the lowest corner of a sole, hand or knee, except in this share of the frames
# (noise).
_BELOW_GROUND_SHARE = 0.02
# A sole is level if its points differ in height by less than this share of its length.
_LEVEL = 0.1
# In lengths of a sole, how deep its toes may go below the ground where the foot rolls over them.
_DEEPEST = 0.5


@dataclass(frozen=True, eq=False)
class Targets:
    """T poses for J bodies, in the world.

    Attributes:
        positions: (T, J, 3) m, of the near ends of the bodies. Limbs have the figure's lengths and
            the source's directions; pelvis and feet are scaled by the length of the legs.
        turns: (T, 4) xyzw, attitudes of the bodies that follow the source's, by name.
        scale: the figure's leg length divided by the source's.
        contacts: (T, K) of each foot, which points of its sole rest on the ground.
    """

    positions: FloatArray
    turns: dict[str, FloatArray]
    scale: float
    contacts: dict[str, Flags]


def make_targets(source: SourceMotion, figure: Figure) -> Targets:
    """Return the targets of a figure that moves as the source does."""
    turns = dict(source.turns)
    scale = figure.leg_length_m / leg_length(source.places)
    scaled = {body: place * scale for body, place in source.places.items()}
    for foot in source.levelled:
        turns[foot] = _levelled(turns[foot], scaled[foot], source.fps, foot)
    target = {foot: scaled[foot] for foot in FEET}
    target["pelvis"] = 0.5 * (scaled["right_thigh"] + scaled["left_thigh"])
    if figure.pins_feet:
        _widen_stance(target, figure, scaled, turns)
    _add_other_bodies(target, figure, source, turns)
    soles = {foot: figure.soles[foot].lowest(turns[foot]) + target[foot][:, 2] for foot in FEET}
    lowest = [target[body][:, 2] - radius for body, radius in figure.round_m.items()]
    ground = float(np.quantile(np.min([*soles.values(), *lowest], axis=0), _BELOW_GROUND_SHARE))
    if figure.pins_feet:
        ground += _ground_of_level_soles(target, figure, turns, source.fps, ground)
    positions = np.stack([target[body] for body in figure.body_names], axis=1)
    positions[..., 2] -= ground
    contacts: dict[str, Flags] = {}
    for foot in FEET:
        column = figure.body_names.index(foot)
        sole, feet = figure.soles[foot], positions[:, column]
        if figure.pins_feet:
            pinned = pin_feet(sole, feet, turns[foot], source.fps)
            contacts[foot], positions[:, column], turns[foot] = pinned
        else:
            # Not below the ground, whatever the noise.
            feet[:, 2] += np.maximum(ground - soles[foot], 0.0)
            contacts[foot] = find_contacts(sole.places(feet, turns[foot]), source.fps)
    return Targets(positions, turns, scale, contacts)


def _ground_of_level_soles(
    target: dict[str, FloatArray],
    figure: Figure,
    turns: dict[str, FloatArray],
    fps: float,
    ground: float,
) -> float:
    """Return how much higher (m) the ground is where soles are level and hardly move.

    A sole longer than the source's goes below the ground where the foot rolls over its toes.
    """
    heights = []
    for foot in FEET:
        sole = figure.soles[foot]
        points = sole.places(target[foot], turns[foot])
        speed = np.linalg.norm(np.gradient(points, axis=0), axis=-1).max(axis=1) * fps
        level = np.ptp(points[..., 2], axis=1) < _LEVEL * sole.length_m
        heights.append(points[..., 2].min(axis=1)[level & (speed < _CONTACT_SPEED)])
    resting = np.concatenate(heights)
    if len(resting) < _FEWEST_CONTACT_FRAMES:
        return 0.0
    above = float(np.quantile(resting, _BELOW_GROUND_SHARE)) - ground
    most = _DEEPEST * max(figure.soles[foot].length_m for foot in FEET)
    return min(above, most) if above > CONTACT_LOW_M else 0.0


def _widen_stance(
    target: dict[str, FloatArray],
    figure: Figure,
    scaled: dict[str, FloatArray],
    turns: dict[str, FloatArray],
) -> None:
    """Move the feet apart as the figure's hips are wider than the scaled source's.

    Legs keep their directions from the hips. The way is the foot's own left, so that a foot that
    stands is moved by the same vector in all frames.
    """
    rest = figure.rest_places()
    own = float(np.linalg.norm(rest["left_thigh"] - rest["right_thigh"]))
    theirs = np.linalg.norm(scaled["left_thigh"] - scaled["right_thigh"], axis=1).mean()
    for foot, sign in zip(FEET, (-0.5, 0.5), strict=True):
        left = rotate(turns[foot], np.array((0.0, 1.0, 0.0))) * (1.0, 1.0, 0.0)
        target[foot] = target[foot] + sign * (own - theirs) * left


def _add_other_bodies(
    target: dict[str, FloatArray],
    figure: Figure,
    source: SourceMotion,
    turns: dict[str, FloatArray],
) -> None:
    """Place trunk and limbs from the pelvis outwards; without a source, at the parent's place.

    Sword and shield are no targets; they have the places of the hands.
    """
    places = source.places
    for i, body in enumerate(figure.body_names):
        if body in target:
            continue
        parent = figure.body_names[figure.parent_indices[i]]
        offset = figure.offsets[i]
        if body.partition("_")[2] in _LIMBS:
            way = places[body] - places[parent]
            length = np.linalg.norm(way, axis=1, keepdims=True)
            step = way / np.maximum(length, 1e-9) * np.linalg.norm(offset)
        elif parent in turns and body in places:
            step = rotate(turns[parent], offset)
        else:
            step = np.zeros(3)
        target[body] = target[parent] + step


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
    return rotated_in_body(turns, rotations.quat_from_angle_axis(angle, axis).numpy())
