"""Target poses of a figure's bodies: the source's motion, scaled limb by limb."""

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

Flags = npt.NDArray[np.bool_]  # True where a point touches the ground

# A point of a sole touches the ground while it is this low and slow. The sole is not exactly the
# source's: where the foot rolls over heel or toes, its own edge is a little off the source's.
CONTACT_LOW_M, _SLOW_M_S = 0.02, 0.5
# A foot that swings is at least this high in the middle of its way, for a foot of 1 m: less would
# scrape. Near its ends it rises and sinks in this share of the way.
_CLEARANCE, _RISE_SHARE, _BLEND = 0.12, 0.3, 0.05
_MOST_TWIST_RAD = np.radians(20.0)
# Contacts of this length are noise, and so are gaps in them.
_NOISE_S = 0.05
# A point this much above the lowest one bears 1 / e of its share of a foot.
_RESTS_M = 0.005


def pin_feet(
    sole: Sole, feet: FloatArray, turns: FloatArray, fps: float
) -> tuple[Flags, FloatArray, FloatArray]:
    """Return where points (T, K) touch, and a foot's places (T, 3), attitudes (T, 4) at rest there.

    Between contacts the correction passes smoothly from the last contact's to the next one's.
    `feet` (T, 3) m are places over the ground z = 0, `turns` (T, 4) xyzw the attitudes.
    """
    contact = find_contacts(sole.places(feet, turns), fps)
    touching = np.any(contact, axis=1)
    turns = _untwisted(sole, feet, turns, contact)
    points = sole.places(feet, turns)
    moved = _planted(points, contact)
    _bridge(moved, touching)
    least = _CLEARANCE * sole.length_m * swing_profile(touching) - points[..., 2].min(axis=1)
    # The larger height, rounded where both cross in a swing.
    width = _BLEND * sole.length_m
    round_off = np.maximum(width - np.abs(moved[:, 2] - least), 0.0) ** 2 / (4.0 * width)
    moved[:, 2] = np.maximum(moved[:, 2], least) + np.where(~touching, round_off, 0.0)
    return contact, feet + moved, turns


def _untwisted(sole: Sole, feet: FloatArray, turns: FloatArray, contact: Flags) -> FloatArray:
    """Return the attitudes (T, 4) without rotation about z between points in contact.

    A foot that turns far on the ground, as dancers' do, keeps its turn.
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
    """Return the rotation in rad that fits two sets of points (K, 2) best; 0 of a single one."""
    if len(before) < 2:
        return 0.0
    a, b = before - before.mean(axis=0), after - after.mean(axis=0)
    cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    return float(np.arctan2(cross, float((a * b).sum())))


def swing_profile(touching: Flags) -> FloatArray:
    """Return 0 (T,) in contact, 1 in the middle of each swing, with smooth ways between.

    At the ends of the motion a swing is cut off; there it stays as high as it has become.
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
    """Return how the root must rise (T,) m so that the lowest point in contact is on the ground.

    Between contacts it passes smoothly from one to the next; no point stays below the ground. The
    points (T, ..., 3) m are of all soles, and `contact` (T, ...) says which touch.
    """
    heights = np.where(contact, points[..., 2], np.inf).reshape(len(points), -1).min(axis=1)
    touching = np.isfinite(heights)
    rise = np.where(touching, -heights, 0.0)[:, None]
    _bridge(rise, touching)
    lowest = points[..., 2].reshape(len(points), -1).min(axis=1)
    return np.maximum(rise[:, 0], -lowest)


def replanted(points: FloatArray, wanted: FloatArray, contact: Flags) -> FloatArray:
    """Return how a foot must move (T, 3) m so that it rests without sliding, near where it should.

    Between contacts it passes smoothly from one to the next. The sole's points (T, K, 3) m are to
    be at `wanted`; those in `contact` (T, K) touch the ground.
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
    """Return how a foot must move (T, 3) so that its points rest on z = 0; 0 between contacts.

    In the plane the mean of a contact's shift is zero: the foot stays where the source has it.
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
    """Return how much of a foot rests on each point, (T, K) with sum 1, 0 without contact.

    A foot rests on its lowest points. Other points in contact are a little higher, and move as the
    foot rolls over its heel or toes; their weight falls with their height, without a jump.
    """
    above = heights - np.where(contact, heights, np.inf).min(axis=1, keepdims=True)
    weights = np.where(contact, np.exp(-np.where(contact, above, 0.0) / _RESTS_M), 0.0)
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)


def find_contacts(points: FloatArray, fps: float) -> Flags:
    """Return which of the points (T, K, 3) m touch the ground z = 0, (T, K)."""
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
    """Return (start, end) of every run of True in (T,), the end excluded."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]


def _bridge(values: FloatArray, known: Flags) -> None:
    """Fill the rows of (T, D) that are not known with smooth ways between the known ones."""
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
    """T poses for J bodies, in the world."""

    # (T, J, 3) m, of the near ends of the bodies. Limbs have the figure's lengths and the source's
    # directions; pelvis and feet are scaled by the length of the legs.
    positions: FloatArray
    # (T, 4) xyzw, attitudes of the bodies that follow the source's, by name.
    turns: dict[str, FloatArray]
    scale: float  # the figure's leg length divided by the source's
    contacts: dict[str, Flags]  # (T, K) of each foot, which points of its sole rest on the ground


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
