"""Which points of a foot touch the ground, and where the foot must be so that they rest there."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.figure import Sole
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
    """Return places and attitudes of a foot whose points in contact rest on the ground.

    Between contacts the correction passes smoothly from the last contact's to the next one's.

    Args:
        sole: its points.
        feet: (T, 3) m, the foot over the ground z = 0.
        turns: (T, 4) xyzw, its attitude.
        fps: frames per second.

    Returns:
        Which points are in contact (T, K), and the places (T, 3) and attitudes (T, 4) of the foot.
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

    Between contacts it passes smoothly from one to the next; no point stays below the ground.

    Args:
        points: (T, ..., 3) m, of all soles.
        contact: (T, ...), which of them are in contact.
    """
    heights = np.where(contact, points[..., 2], np.inf).reshape(len(points), -1).min(axis=1)
    touching = np.isfinite(heights)
    rise = np.where(touching, -heights, 0.0)[:, None]
    _bridge(rise, touching)
    lowest = points[..., 2].reshape(len(points), -1).min(axis=1)
    return np.maximum(rise[:, 0], -lowest)


def replanted(points: FloatArray, wanted: FloatArray, contact: Flags) -> FloatArray:
    """Return how a foot must move (T, 3) m so that it rests without sliding, near where it should.

    Between contacts it passes smoothly from one to the next.

    Args:
        points: (T, K, 3) m, of its sole, where they are.
        wanted: (T, K, 3) m, where they should be.
        contact: (T, K), which of them are in contact.
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
