"""The mirror image of a clip."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.mirror import mirror_clip, mirror_rotations, partners


def test_sides_change_places() -> None:
    assert partners(("pelvis", "right_foot", "left_foot", "head")) == [0, 2, 1, 3]


def test_a_side_without_its_partner_is_refused() -> None:
    with pytest.raises(ValueError, match="left_foot"):
        partners(("pelvis", "right_foot"))


def test_only_turns_about_y_keep_their_sense(about: Callable[..., np.ndarray]) -> None:
    names = ("right_arm", "left_arm")
    for axis, sign in (("x", -1.0), ("y", 1.0), ("z", -1.0)):
        right, left = about(axis, [0.4]), about(axis, [0.1])
        mirrored = mirror_rotations(names, np.stack((right, left), axis=1))
        np.testing.assert_allclose(mirrored[:, 0], about(axis, [sign * 0.1]))
        np.testing.assert_allclose(mirrored[:, 1], about(axis, [sign * 0.4]))


def test_bodies_go_to_mirrored_places(make_humanoid_clip: Callable[..., MotionClip]) -> None:
    """Positions by kinematics of the mirrored joints are the mirror images of the positions."""
    clip = bent(make_humanoid_clip(4))
    image = mirror_clip(clip, "image")
    assert image.name == "image"
    order = partners(clip.body_names)
    positions, mirrored = clip.global_poses()[0], image.global_poses()[0]
    np.testing.assert_allclose(mirrored, positions[:, order] * (1.0, -1.0, 1.0), atol=1e-9)


def test_velocities_are_those_of_the_mirrored_motion(
    make_humanoid_clip: Callable[..., MotionClip],
) -> None:
    clip = bent(make_humanoid_clip(20))
    args = (clip.fps, clip.body_names, clip.parent_indices, clip.local_translation)
    made = MotionClip.from_poses("made", *args, clip.local_rotation, clip.root_translation)
    image = mirror_clip(made, "image")
    again = MotionClip.from_poses("again", *args, image.local_rotation, image.root_translation)
    assert np.abs(made.angular_velocity_w[..., [0, 2]]).max() > 0.1
    np.testing.assert_allclose(image.linear_velocity_w, again.linear_velocity_w, atol=1e-9)
    np.testing.assert_allclose(image.angular_velocity_w, again.angular_velocity_w, atol=1e-9)


def test_the_image_of_the_image_is_the_clip(make_humanoid_clip: Callable[..., MotionClip]) -> None:
    clip = bent(make_humanoid_clip(3))
    twice = mirror_clip(mirror_clip(clip, "image"), clip.name)
    for field in dataclasses.fields(clip):
        np.testing.assert_array_equal(getattr(twice, field.name), getattr(clip, field.name))


def bent(clip: MotionClip) -> MotionClip:
    """Turn all joints, each about an axis of its own, more and more, and let the root drift."""
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(clip.num_bodies, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    half = np.linspace(0.1, 0.3, clip.num_frames)[:, None, None]
    turns = np.concatenate((np.sin(half) * axes, np.cos(half) + 0.0 * axes[:, :1]), axis=-1)
    root = clip.root_translation.copy()
    root[:, 1] = 0.05 * np.arange(clip.num_frames)
    return dataclasses.replace(clip, local_rotation=turns, root_translation=root)
