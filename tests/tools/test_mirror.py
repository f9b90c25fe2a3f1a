"""Tests the mirror image of a clip."""

from __future__ import annotations

import dataclasses

import numpy as np

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.loader import load_clips
from tools.clip_synthesis.mirror import mirror_clip, partners


def test_bodies_go_to_mirrored_places() -> None:
    """The kinematics of mirrored joints give mirrored positions."""
    clip = bent(load_clips("walk")[0][0])
    image = mirror_clip(clip, "image")
    assert image.name == "image"
    order = partners(clip.body_names)
    positions, mirrored = clip.global_poses()[0], image.global_poses()[0]
    np.testing.assert_allclose(mirrored, positions[:, order] * (1.0, -1.0, 1.0), atol=1e-9)


def test_velocities_are_those_of_the_mirrored_motion() -> None:
    clip = bent(load_clips("walk")[0][0])
    args = (clip.fps, clip.body_names, clip.parent_indices, clip.local_translation)
    made = MotionClip.from_poses("made", *args, clip.local_rotation, clip.root_translation)
    image = mirror_clip(made, "image")
    again = MotionClip.from_poses("again", *args, image.local_rotation, image.root_translation)
    assert np.abs(made.angular_velocity_w[..., [0, 2]]).max() > 0.1
    np.testing.assert_allclose(image.linear_velocity_w, again.linear_velocity_w, atol=1e-9)
    np.testing.assert_allclose(image.angular_velocity_w, again.angular_velocity_w, atol=1e-9)


def bent(clip: MotionClip) -> MotionClip:
    """Turn each joint about a different axis with growing angles while the root drifts."""
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(clip.num_bodies, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    half = np.linspace(0.1, 0.3, clip.num_frames)[:, None, None]
    turns = np.concatenate((np.sin(half) * axes, np.cos(half) + 0.0 * axes[:, :1]), axis=-1)
    root = clip.root_translation.copy()
    root[:, 1] = 0.05 * np.arange(clip.num_frames)
    return dataclasses.replace(clip, local_rotation=turns, root_translation=root)
