"""Tests the targets of a source motion: size, ground and soles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.retargeting.bvh import read_bvh
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping
from isaacgymenvs_lite.motion.retargeting.source import Sole, humanoid_figure, source_from_bvh
from isaacgymenvs_lite.motion.retargeting.targets import (
    find_contacts,
    make_targets,
    onto_ground,
    pin_feet,
    replanted,
)


def targets_of(path: Path, rig: str, skeleton):
    mapping = load_mapping(rig)
    clip = read_bvh(path).clip(mapping.to_z_up, mapping.unit_m)
    return make_targets(source_from_bvh(clip, mapping), humanoid_figure(skeleton))


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_size_is_taken_from_the_legs(tmp_path: Path, write_bvh, humanoid, size) -> None:
    path = write_bvh(tmp_path / "a.bvh", load_clips("stand")[0][0], "cmu", size=size, arms=1.3)
    assert targets_of(path, "cmu", humanoid).scale == pytest.approx(1.0 / size, rel=1e-5)


@pytest.mark.parametrize("height", [-0.3, 2.0])
def test_soles_stand_on_the_ground_wherever_the_file_has_it(
    tmp_path: Path, write_bvh, humanoid, make_humanoid_clip, height
) -> None:
    clip = make_humanoid_clip(num_frames=10)
    clip.root_translation[:, 0] = 0.0
    clip.root_translation[:, 2] += height
    targets = targets_of(write_bvh(tmp_path / "a.bvh", clip, "lafan1"), "lafan1", humanoid)
    # Upright, the pelvis is 0.8814 m over the soles.
    np.testing.assert_allclose(targets.positions[:, 0, 2], 0.8814, atol=1e-4)


def test_hands_may_touch_the_ground(
    tmp_path: Path, write_bvh, humanoid, make_humanoid_clip, about
) -> None:
    clip = make_humanoid_clip(num_frames=10)
    clip.local_rotation[:, 0] = about("x", [np.pi] * 10)  # upside down, arms still along the trunk
    for side, sign in (("right", 1.0), ("left", -1.0)):
        arm = humanoid.body_names.index(f"{side}_upper_arm")
        clip.local_rotation[:, arm] = about("x", [sign * np.pi] * 10)
    targets = targets_of(write_bvh(tmp_path / "a.bvh", clip, "cmu"), "cmu", humanoid)
    hands = [humanoid.body_names.index(f"{side}_hand") for side in ("right", "left")]
    np.testing.assert_allclose(targets.positions[:, hands, 2], 0.04, atol=1e-4)  # their radius


def test_a_sole_on_edge_is_levelled_and_one_that_never_stands_is_not(
    tmp_path: Path, write_bvh, humanoid, make_humanoid_clip, about, caplog
) -> None:
    clip = make_humanoid_clip(num_frames=10)
    clip.root_translation[:, 0] = 0.0
    tilted = humanoid.body_names.index("right_foot")
    clip.local_rotation[:, tilted] = about("x", [np.radians(10.0)] * 10)
    clip.local_rotation[:, humanoid.body_names.index("left_shin")] = about(
        "y", np.linspace(0.0, 1.5, 10)
    )
    with caplog.at_level("INFO"):
        targets = targets_of(write_bvh(tmp_path / "a.bvh", clip, "cmu"), "cmu", humanoid)
    np.testing.assert_allclose(targets.turns["right_foot"][:, :2], 0.0, atol=1e-6)
    assert "right_foot: sole levelled by 10.0 deg" in caplog.text
    assert "left_foot: never on the ground" in caplog.text


FPS = 60.0
SOLE = Sole(np.array([[x, y, -0.05] for x in (-0.1, 0.1) for y in (-0.04, 0.04)]), np.zeros(4))


def steps(slip_m_s: float, twist_rad_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a foot that stands for 0.5 s, sliding and twisting, steps 0.4 m, and stands again."""
    feet, turns = np.zeros((90, 3)), np.zeros((90, 4))
    feet[:, 2] = 0.05
    swing = np.arange(1, 31) / 31.0
    left_at = 29 * slip_m_s / FPS
    feet[30:60, 0], feet[60:, 0] = left_at + (0.4 - left_at) * swing, 0.4
    feet[30:60, 2] += 0.1 * np.sin(np.pi * swing)
    for part in (slice(0, 30), slice(60, 90)):
        feet[part, 0] += np.arange(30) * slip_m_s / FPS
        turns[part, 2] = np.sin(0.5 * np.arange(30) * twist_rad_s / FPS)
    turns[:, 3] = np.sqrt(1.0 - turns[:, 2] ** 2)
    return feet, turns


def test_a_foot_that_slides_and_twists_is_held() -> None:
    feet, turns = steps(0.1, 0.5)
    contact, held, attitude = pin_feet(SOLE, feet, turns, FPS)
    assert contact[:29].all()
    assert contact[62:].all()
    assert not contact[34:56].any()
    points = SOLE.places(held, attitude)
    for standing in (slice(0, 29), slice(62, 90)):
        np.testing.assert_allclose(points[standing] - points[standing][:1], 0.0, atol=1e-9)
        np.testing.assert_allclose(points[standing][..., 2], 0.0, atol=1e-12)
        # It stands where the source stands on average.
        np.testing.assert_allclose(
            held[standing].mean(0)[:2], feet[standing].mean(0)[:2], atol=2e-3
        )
    # No frame jumps: the swing's own speed is 0.8 m/s, and 0.6 m/s up.
    assert np.linalg.norm(np.diff(held, axis=0), axis=1).max() * FPS < 1.5


def test_a_dancer_may_turn_on_the_ground() -> None:
    feet, turns = steps(0.0, 2.0)  # 1 rad in half a second
    _, _, attitude = pin_feet(SOLE, feet, turns, FPS)
    np.testing.assert_allclose(np.abs(attitude[:30, 2]), np.abs(turns[:30, 2]), atol=1e-9)


def test_swings_are_as_high_as_their_profile_and_never_in_the_ground() -> None:
    feet, turns = steps(0.0, 0.0)
    feet[30:60, 2] = 0.045  # through the ground
    feet[30:60, 0] *= 2.0  # fast enough to be no contact
    contact, held, attitude = pin_feet(SOLE, feet, turns, FPS)
    heights = SOLE.places(held, attitude)[..., 2].min(axis=1)
    assert heights.min() > -1e-12
    flying = np.flatnonzero(~contact.any(axis=1))
    assert heights[flying[len(flying) // 2]] > 0.02  # 12 % of a foot of 0.2 m


def test_short_contacts_and_gaps_are_noise() -> None:
    points = np.zeros((60, 1, 3))
    points[20, 0, 2] = 0.1  # one frame in the air
    assert find_contacts(points, FPS).all()
    points[:, 0, 2] = 0.1
    points[30:32, 0, 2] = 0.0  # two frames on the ground
    assert not find_contacts(points, FPS).any()


def test_the_root_rises_with_the_lowest_point_in_contact() -> None:
    points = np.zeros((5, 2, 3))
    points[:, 0, 2] = [-0.02, -0.02, 0.3, 0.01, 0.01]
    points[:, 1, 2] = 0.5
    contact = np.zeros((5, 2), bool)
    contact[[0, 1, 3, 4], 0] = True
    np.testing.assert_allclose(
        onto_ground(points, contact), [0.02, 0.02, 0.005, -0.01, -0.01], atol=1e-12
    )


def pitched(sole: Sole, feet: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return the points of a sole whose foot is turned about y by angles (T,) rad."""
    return sole.places(feet, about_y(angles))


def about_y(angles: np.ndarray) -> np.ndarray:
    zeros = np.zeros_like(angles)
    return np.stack((zeros, np.sin(0.5 * angles), zeros, np.cos(0.5 * angles)), axis=1)


# A thick sole: above each toe another point, as the corners of boxes have.
THICK = Sole(np.concatenate((SOLE.points, SOLE.points[2:] + np.array((0, 0, 0.015)))), np.zeros(6))


def rolls_over_its_toes(sole: Sole) -> tuple[np.ndarray, np.ndarray]:
    """Return a foot (T, 3) that lifts its heel within half a second, and its angles (T,) rad."""
    angles = np.linspace(0.0, 0.6, 30)
    toes = pitched(sole, np.zeros((30, 3)), angles)[:, 2]
    return np.array((0.1, 0.0, 0.0)) - toes * (1.0, 0.0, 1.0), angles


def test_a_foot_rolls_over_the_edge_of_its_toes() -> None:
    feet, angles = rolls_over_its_toes(THICK)
    slides = feet + np.linspace(0.0, 0.03, 30)[:, None] * np.array((1.0, 0.0, 0.0))
    _, held, turns = pin_feet(THICK, slides, about_y(angles), FPS)
    toes = THICK.places(held, turns)[:, 2]
    # The mean of all points would let the edge slide at 0.01 m/s and more.
    speed = np.abs(np.diff(toes[:, 0])) * FPS
    assert speed.max() < 0.005


def test_a_foot_of_another_attitude_is_replanted() -> None:
    """A foot with its ankle at the limit stays flat and must rest at its place without sliding."""
    feet, angles = rolls_over_its_toes(SOLE)
    wanted = pitched(SOLE, feet, angles)
    contact = find_contacts(wanted, FPS)
    moved = feet + np.linspace(0.0, 0.02, 30)[:, None] * (1.0, 1.0, 2.0)
    points = pitched(SOLE, moved, np.zeros(30))
    rests = points + replanted(points, wanted, contact)[:, None]
    np.testing.assert_allclose(rests[..., 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(rests[..., :2], axis=0), 0.0, atol=1e-12)
    middle = (wanted - rests)[..., :2]
    assert abs(middle[contact].mean(axis=0)).max() < 0.01
