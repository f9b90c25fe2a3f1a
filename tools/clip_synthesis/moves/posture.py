"""Computes the rotations of trunk, head and arms for the feet of a move."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations
from tools.clip_synthesis.moves.contacts import SIDES, FootTrack
from tools.clip_synthesis.moves.move import Carriage
from tools.clip_synthesis.moves.path import Path, ease
from tools.clip_synthesis.posture import compose, turn

_SMOOTH_S = 0.12  # half width of the window that smooths the motion of trunk and arms
_SMOOTH_SAMPLES = 9


def target_rotations(
    carriage: Carriage,
    skeleton: Skeleton,
    tracks: tuple[FootTrack, FootTrack],
    path: Path,
    times_s: FloatArray,
) -> FloatArray:
    """Return rotations relative to the parents (n, J, 4) xyzw at times (n) with straight legs.

    The root's rotation is relative to the world.
    """
    yaw = path(times_s)[:, 2]
    apart = _smooth(lambda t: _feet_apart(tracks, path, t), times_s)
    uneven = _smooth(lambda t: _uneven_load(tracks, t), times_s)
    lean, tilt, twist, nod = (
        np.radians(ease(knots, times_s)[:, 0])
        for knots in (carriage.lean, carriage.pelvis_tilt, carriage.twist, carriage.nod)
    )
    # With the left foot ahead `apart` is positive, and the pelvis' left side is ahead, too.
    pelvis = compose(
        turn("z", yaw - np.radians(carriage.pelvis_turn_deg_per_m) * apart),
        turn("y", tilt),
        turn("x", np.radians(carriage.pelvis_drop_deg) * uneven),
    )
    thorax = compose(
        turn("z", yaw + twist + np.radians(carriage.thorax_turn_deg_per_m) * apart),
        turn("y", lean),
    )
    look = compose(turn("z", path(times_s + carriage.look_ahead_s)[:, 2]), turn("y", nod))
    turns = {name: turn("x", np.zeros_like(times_s)) for name in skeleton.body_names}
    turns["pelvis"] = pelvis
    turns["torso"] = rotations.quat_mul(rotations.quat_conjugate(pelvis), thorax)
    turns["head"] = rotations.quat_mul(rotations.quat_conjugate(thorax), look)
    for name, side in SIDES:
        shoulder, abduction, rotation, elbow = _arm_angles(carriage, side, apart, times_s)
        # Positive turns about y swing a hanging arm backwards and stretch the elbow.
        turns[f"{name}_upper_arm"] = compose(
            turn("y", -shoulder), turn("x", side * abduction), turn("z", -side * rotation)
        )
        turns[f"{name}_lower_arm"] = turn("y", -elbow)
    return torch.stack([turns[name] for name in skeleton.body_names], dim=1).numpy()


def _arm_angles(
    carriage: Carriage, side: float, apart: FloatArray, times_s: FloatArray
) -> FloatArray:
    """Return shoulder, abduction, rotation, elbow (4, n) in rad; `side` is a sign of `SIDES`."""
    if side < 0.0 and carriage.right_arm:
        return np.radians(ease(carriage.right_arm, times_s).T)
    swing = -side * np.radians(carriage.arm_swing_deg_per_m) * apart
    shoulder, elbow = (
        np.radians(ease(knots, times_s)[:, 0]) for knots in (carriage.shoulder, carriage.elbow)
    )
    aside, inward = (
        np.full_like(apart, np.radians(angle))
        for angle in (carriage.abduction_deg, carriage.rotation_deg)
    )
    return np.stack((shoulder + swing, aside, inward, elbow + carriage.elbow_share * swing))


def _feet_apart(tracks: tuple[FootTrack, FootTrack], path: Path, times_s: FloatArray) -> FloatArray:
    """Return how far (n) in m the left foot is ahead of the right foot along the heading."""
    right, left = (track.poses(times_s) for track in tracks)
    yaw = path(times_s)[:, 2]
    way = left[:, :2] - right[:, :2]
    return way[:, 0] * np.cos(yaw) + way[:, 1] * np.sin(yaw)


def _uneven_load(tracks: tuple[FootTrack, FootTrack], times_s: FloatArray) -> FloatArray:
    """Return the load of the left foot minus the load of the right foot, (n) in [-1, 1]."""
    right, left = (track.load(times_s) for track in tracks)
    return (left - right) / np.maximum(left + right, 1.0)


def _smooth(signal: Callable[[FloatArray], FloatArray], times_s: FloatArray) -> FloatArray:
    """Return the mean of a function of time around times (n) with Hann weights."""
    weights = np.hanning(_SMOOTH_SAMPLES + 2)[1:-1]
    shifts = np.linspace(-_SMOOTH_S, _SMOOTH_S, _SMOOTH_SAMPLES)
    values = [
        weight * signal(times_s + shift) for weight, shift in zip(weights, shifts, strict=True)
    ]
    return np.sum(values, axis=0) / weights.sum()
