"""Computes target poses for a figure's bodies from the source motion and the figure's lengths."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.source import (
    FEET,
    Figure,
    Sole,
    SourceMotion,
    leg_length,
    rotate,
    rotated_in_body,
)
from isaacgymenvs_lite.utils import rotations

Flags = npt.NDArray[np.bool_]  # True for points on the ground

# Height (m) and speed (m/s) below which a point of a sole touches the ground.
CONTACT_LOW_M, _SLOW_M_S = 0.02, 0.5
_CLEARANCE = 0.12  # least height of a foot in the middle of a swing, in sole lengths
_RISE_SHARE = 0.3  # share of a swing in which the foot rises
_BLEND = 0.05  # height over which two height curves are blended, in sole lengths
_MOST_TWIST_RAD = np.radians(20.0)
# Contacts, and gaps between contacts, that are shorter than this are noise.
_NOISE_S = 0.05
# The weight of a sole's point falls by the factor e for every 5 mm above the lowest point.
_RESTS_M = 0.005


def pin_feet(
    sole: Sole, feet: FloatArray, turns: FloatArray, fps: float
) -> tuple[Flags, FloatArray, FloatArray]:
    """Keep a foot still during contacts; return contacts (T, K) and foot poses (T, 3), (T, 4).

    The correction changes smoothly between contacts. `feet` (T, 3) m are the foot's positions, with
    the ground at z = 0, and `turns` (T, 4) xyzw are the foot's rotations.
    """
    contact = find_contacts(sole.places(feet, turns), fps)
    touching = np.any(contact, axis=1)
    turns = _untwisted(sole, feet, turns, contact)
    points = sole.places(feet, turns)
    moved = _planted(points, contact)
    _bridge(moved, touching)
    least = _CLEARANCE * sole.length_m * swing_profile(touching) - points[..., 2].min(axis=1)
    # The height of a foot is the larger of two heights, with a smooth transition in a swing.
    width = _BLEND * sole.length_m
    round_off = np.maximum(width - np.abs(moved[:, 2] - least), 0.0) ** 2 / (4.0 * width)
    moved[:, 2] = np.maximum(moved[:, 2], least) + np.where(~touching, round_off, 0.0)
    return contact, feet + moved, turns


def _untwisted(sole: Sole, feet: FloatArray, turns: FloatArray, contact: Flags) -> FloatArray:
    """Return a foot's rotations (T, 4) without rotation about z during contacts.

    If a foot rotates far on the ground, for example in a dance, the rotations do not change.
    """
    points = sole.places(feet, turns)[..., :2]
    touching = np.any(contact, axis=1)
    twist = np.zeros((len(feet), 1))
    for start, end in spans(touching):
        steps = []
        for i in range(start + 1, end):
            both = contact[i - 1] & contact[i]
            steps.append(_twist(points[i - 1][both], points[i][both]))
        total = np.concatenate(([0.0], -np.cumsum(steps)))
        if np.ptp(total) < _MOST_TWIST_RAD:
            twist[start:end, 0] = total - total.mean()
    _bridge(twist, touching)
    up = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64).expand(len(feet), 3)
    about_z = rotations.quat_from_angle_axis(torch.from_numpy(twist[:, 0]), up)
    return rotations.quat_mul(about_z, torch.from_numpy(turns)).numpy()


def _twist(before: FloatArray, after: FloatArray) -> float:
    """Return the angle in rad that best rotates one set of points (K, 2) into the other.

    For a single point the angle is 0.
    """
    if len(before) < 2:
        return 0.0
    a, b = before - before.mean(axis=0), after - after.mean(axis=0)
    cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    return float(np.arctan2(cross, float((a * b).sum())))


def swing_profile(touching: Flags) -> FloatArray:
    """Return a smooth curve (T,) that is 0 in contacts and 1 in the middle of each swing.

    If the motion begins or ends in a swing, the curve is 1 from the first or last frame to the
    middle of this swing.
    """
    profile = np.zeros(len(touching))
    for start, end in spans(~touching):
        share = np.arange(1, end - start + 1) / (end - start + 1)
        rise = np.ones_like(share) if start == 0 else np.minimum(share / _RISE_SHARE, 1.0)
        if end < len(touching):
            rise = np.minimum(rise, (1.0 - share) / _RISE_SHARE)
        profile[start:end] = _smoothed(np.clip(rise, 0.0, 1.0))
    return profile


def _smoothed(share: FloatArray) -> FloatArray:
    return share * share * (3.0 - 2.0 * share)


def onto_ground(points: FloatArray, contact: Flags) -> FloatArray:
    """Return the height (T,) m by which the root must rise, so that feet are on the ground.

    In each frame, the lowest point in contact is moved to z = 0. The height changes smoothly
    between contacts, and no point stays below the ground. `points` (T, ..., 3) m are the points of
    all soles, and `contact` (T, ...) marks points in contact.
    """
    heights = np.where(contact, points[..., 2], np.inf).reshape(len(points), -1).min(axis=1)
    touching = np.isfinite(heights)
    rise = np.where(touching, -heights, 0.0)[:, None]
    _bridge(rise, touching)
    lowest = points[..., 2].reshape(len(points), -1).min(axis=1)
    return np.maximum(rise[:, 0], -lowest)


def replanted(points: FloatArray, wanted: FloatArray, contact: Flags) -> FloatArray:
    """Return the shift (T, 3) m that keeps a foot near `wanted`, and still during contacts.

    The shift changes smoothly between contacts. `points` and `wanted` (T, K, 3) m are the current
    and the desired points of the sole; `contact` (T, K) marks points in contact.
    """
    touching = np.any(contact, axis=1)
    moved = _planted(points, contact)
    share = _resting(points[..., 2], contact)[..., None]
    missed = ((wanted - points)[..., :2] * share).sum(axis=1)
    for start, end in spans(touching):
        moved[start:end, :2] += missed[start:end].mean(axis=0)
    _bridge(moved, touching)
    return moved


def _planted(points: FloatArray, contact: Flags) -> FloatArray:
    """Return the shift (T, 3) m that keeps points in contact still on z = 0.

    Without contact the shift is 0. The mean horizontal shift in a contact is zero, and the foot
    therefore stays near its position in the source motion.
    """
    moved = np.zeros((len(points), 3))
    for start, end in spans(np.any(contact, axis=1)):
        own, touches = points[start:end], contact[start:end]
        steps = np.diff(own[..., :2], axis=0)
        middle = 0.5 * (own[1:, :, 2] + own[:-1, :, 2])
        share = _resting(middle, touches[1:] & touches[:-1])[..., None]
        shift = np.concatenate((np.zeros((1, 2)), -np.cumsum((steps * share).sum(axis=1), axis=0)))
        moved[start:end, :2] = shift - shift.mean(axis=0)
        moved[start:end, 2] = -own[..., 2].min(axis=1)
    return moved


def _resting(heights: FloatArray, contact: Flags) -> FloatArray:
    """Return weights (T, K) of a foot's points, whose sum is 1 in contacts and otherwise 0.

    The weight of a point falls smoothly with the point's height above the lowest point in contact,
    because higher points move while the foot rolls over the heel or the toes.
    """
    above = heights - np.where(contact, heights, np.inf).min(axis=1, keepdims=True)
    weights = np.where(contact, np.exp(-np.where(contact, above, 0.0) / _RESTS_M), 0.0)
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)


def find_contacts(points: FloatArray, fps: float) -> Flags:
    """Return a mask (T, K) of the points (T, K, 3) m that touch the ground z = 0."""
    speed = np.linalg.norm(np.gradient(points, axis=0), axis=-1) * fps
    contact = (points[..., 2] < CONTACT_LOW_M) & (speed < _SLOW_M_S)
    longest = round(_NOISE_S * fps)
    for column in contact.T:
        for start, end in spans(~column):
            if end - start <= longest and start > 0 and end < len(column):
                column[start:end] = True
        for start, end in spans(column):
            if end - start <= longest:
                column[start:end] = False
    return contact


def spans(flags: Flags) -> list[tuple[int, int]]:
    """Return (first index, last index + 1) of every run of True values in an array (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]


def _bridge(values: FloatArray, known: Flags) -> None:
    """Fill unknown rows of an array (T, D) in place by smooth transitions between known rows."""
    if not known.any():
        values[:] = 0.0
        return
    for start, end in spans(~known):
        if start == 0 or end == len(values):
            values[start:end] = values[end] if start == 0 else values[start - 1]
            continue
        share = _smoothed(np.arange(1, end - start + 1) / (end - start + 1))[:, None]
        values[start:end] = values[start - 1] * (1.0 - share) + values[end] * share


_log = logging.getLogger(__name__)

# The direction from the parent to these bodies comes from the source; the distance comes from the
# figure.
_LIMBS = ("lower_arm", "hand", "shin")
# A foot is on the ground while the foot's joint is near its lowest height and slower than this.
_CONTACT_SPEED = 0.2  # m/s
_CONTACT_HEIGHT_M = 0.01
_FEWEST_CONTACT_FRAMES = 5
# A tilt of the sole above this angle is part of the motion; a smaller tilt is an error of the rig.
_MOST_LEVELLING_RAD = np.radians(15.0)
# Share of the frames in which points may be below the ground because of noise.
_BELOW_GROUND_SHARE = 0.02
# Largest difference of the heights of a level sole's points, as a share of the sole's length.
_LEVEL = 0.1
# Largest depth of toes below the ground while a foot rolls over the toes, in sole lengths.
_DEEPEST = 0.5


@dataclass(frozen=True, eq=False)
class Targets:
    """Target poses of J bodies in T frames, in world axes."""

    # (T, J, 3) m, origins of the bodies. Limbs have the figure's lengths and the source motion's
    # directions. Positions of pelvis and feet are scaled by the ratio of the leg lengths.
    positions: FloatArray
    turns: dict[str, FloatArray]  # from bodies to target rotations (T, 4) xyzw, if they have any
    scale: float  # the figure's leg length divided by the source's leg length
    contacts: dict[str, Flags]  # from feet to masks (T, K) of the sole's points on the ground


def make_targets(source: SourceMotion, figure: Figure) -> Targets:
    """Return the target poses of a figure that imitates the source motion."""
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
            # Noise must not move the sole below the ground.
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
    """Return the height (m) of resting soles above `ground`, or 0 if this height is small.

    If the figure's soles are longer than the source's soles, the toes are below the ground while a
    foot rolls over the toes, and the lowest points are not on the ground. Soles that are level and
    slow are on the ground.
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
    """Move the feet apart by the difference of hip widths between the figure and the scaled source.

    The directions of the legs do not change. A foot is moved along the foot's left axis, which is
    constant while the foot stands.
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
    """Add the target positions of trunk and limbs, from the pelvis outwards.

    Bodies that are not in the source (sword and shield) have the positions of their parents.
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
    """Return the rotations (T, 4) of a foot, corrected so that its sole is flat during contacts.

    The foot's frame differs among skeletons. Therefore the foot's up axis is the median over the
    frames in which the foot is on the ground.
    """
    speed = np.linalg.norm(np.gradient(places, axis=0), axis=1) * fps
    low = places[:, 2] < np.quantile(places[:, 2], 0.05) + _CONTACT_HEIGHT_M
    on_ground = low & (speed < _CONTACT_SPEED)
    if np.count_nonzero(on_ground) < _FEWEST_CONTACT_FRAMES:
        _log.info("%s: never on the ground; its sole keeps the mapping's rotation", foot)
        return turns
    upright = np.tile((0.0, 0.0, 1.0), (int(on_ground.sum()), 1))
    inverse = rotations.quat_conjugate(torch.from_numpy(turns[on_ground]))
    up = np.median(rotations.quat_apply(inverse, torch.from_numpy(upright)).numpy(), axis=0)
    up /= np.linalg.norm(up)
    axis = torch.from_numpy(np.cross((0.0, 0.0, 1.0), up))
    angle = torch.atan2(axis.norm(), torch.tensor(up[2]))
    if angle > _MOST_LEVELLING_RAD:
        _log.info("%s: never flat on the ground; its sole keeps the mapping's rotation", foot)
        return turns
    _log.info("%s: sole levelled by %.1f deg", foot, float(torch.rad2deg(angle)))
    return rotated_in_body(turns, rotations.quat_from_angle_axis(angle, axis).numpy())
