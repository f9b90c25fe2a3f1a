import dataclasses

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip


def test_length_counts_the_steps_between_frames(tiny_clip: MotionClip) -> None:
    assert tiny_clip.num_frames == 3
    assert tiny_clip.length_s == pytest.approx(0.2)


def test_from_poses_adds_velocities(tiny_clip: MotionClip) -> None:
    num_frames = 20
    root = np.zeros((num_frames, 3))
    root[:, 0] = 0.1 * np.arange(num_frames)
    clip = MotionClip.from_poses(
        "new",
        10,
        tiny_clip.body_names,
        tiny_clip.parent_indices,
        tiny_clip.local_translation,
        np.repeat(tiny_clip.local_rotation[:1], num_frames, axis=0),
        root,
    )
    # 0.1 m per frame at 10 fps; the pose is stiff, so every body moves alike.
    expected = np.tile([1.0, 0.0, 0.0], (num_frames, 3, 1))
    np.testing.assert_allclose(clip.linear_velocity_w, expected, atol=1e-12)
    np.testing.assert_allclose(clip.angular_velocity_w, 0.0, atol=1e-12)


def _with_nan(clip: MotionClip) -> dict:
    root = clip.root_translation.copy()
    root[1, 2] = np.nan
    return {"root_translation": root}


def _first_frame(clip: MotionClip) -> dict:
    names = ("local_rotation", "root_translation", "linear_velocity_w", "angular_velocity_w")
    return {name: getattr(clip, name)[:1] for name in names}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (_with_nan, r"root_translation holds 1 number.*NaN.*\(1, 2\)"),
        (_first_frame, "holds 1 frame.*at least 2"),
        (lambda clip: {"fps": 0.0}, "fps is 0, expected 0.1 to 10000"),
        (lambda clip: {"fps": float("nan")}, "fps is nan"),
        (lambda clip: {"fps": 1e308}, "fps is 1e.308, expected 0.1 to 10000"),
        (lambda clip: {"fps": 0.01}, "fps is 0.01"),
        (
            lambda clip: {"linear_velocity_w": np.full((3, 3, 3), 1e30)},
            "linear_velocity_w has 1e.30 m/s, expected at most 1000 m/s",
        ),
        (lambda clip: {"angular_velocity_w": np.full((3, 3, 3), -1e6)}, "1e.06 rad/s"),
        (lambda clip: {"root_translation": np.full((3, 3), 2e4)}, "root_translation has 2e.04 m"),
        (lambda clip: {"local_translation": np.full((3, 3), -90.0)}, "local_translation has 90 m"),
        (lambda clip: {"local_rotation": 1.01 * clip.local_rotation}, "'root'.*no unit.*0.01"),
        (lambda clip: {"parent_indices": (-1, 0, -1)}, "2 roots, expected 1"),
        (lambda clip: {"parent_indices": (-1, 2, 0)}, "'arm' comes before its parent"),
        (lambda clip: {"body_names": ("root", "arm", "arm")}, "not unique"),
        (
            lambda clip: {"linear_velocity_w": clip.linear_velocity_w[:2]},
            r"linear_velocity_w has shape \(2, 3, 3\), expected \(3, 3, 3\)",
        ),
        (lambda clip: {"local_rotation": np.zeros(())}, "local_rotation has shape"),
    ],
)
def test_invalid_clips_are_refused(tiny_clip: MotionClip, changes, message: str) -> None:
    clip = dataclasses.replace(tiny_clip, **changes(tiny_clip))
    with pytest.raises(MotionFileError, match=f"^tiny: .*{message}") as raised:
        clip.validate()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("frames", "kept"),
    [
        ([0, 0, 1, 1, 2, 2], [0, 1, 2]),
        ([0, 0, 1, 1, 2], [0, 1, 2]),
        ([0, 1, 1, 2, 2], [0, 1, 2]),  # trimmed in the middle of a pair
    ],
)
def test_repeated_frames_are_dropped(tiny_clip: MotionClip, frames, kept) -> None:
    doubled = _take(tiny_clip, frames)
    repaired = doubled.drop_repeated_frames()
    assert repaired.fps == 5.0
    expected = _take(tiny_clip, kept)
    np.testing.assert_array_equal(repaired.local_rotation, expected.local_rotation)
    np.testing.assert_array_equal(repaired.root_translation, expected.root_translation)
    np.testing.assert_array_equal(repaired.linear_velocity_w, expected.linear_velocity_w)
    np.testing.assert_array_equal(repaired.angular_velocity_w, expected.angular_velocity_w)


@pytest.mark.parametrize("frames", [[0, 1, 2], [0, 0, 0, 0, 0], [0, 0, 1], [0, 0, 1, 1, 2, 0]])
def test_standing_still_for_a_while_is_no_repetition(tiny_clip: MotionClip, frames) -> None:
    clip = _take(tiny_clip, frames)
    assert clip.find_repeated_frames() is None
    assert clip.drop_repeated_frames() is clip


def _take(clip: MotionClip, frames: list[int]) -> MotionClip:
    return dataclasses.replace(
        clip,
        local_rotation=clip.local_rotation[frames],
        root_translation=clip.root_translation[frames],
        linear_velocity_w=clip.linear_velocity_w[frames],
        angular_velocity_w=clip.angular_velocity_w[frames],
    )
