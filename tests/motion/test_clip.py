from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import JointClip, MotionClip


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


def test_invalid_clips_are_one_line(tiny_clip: MotionClip) -> None:
    root = tiny_clip.root_translation.copy()
    root[1, 2] = np.nan
    first_frame = {key: values[:1] for key, values in tiny_clip.timed_arrays().items()}
    for changes, message in (
        ({"root_translation": root}, r"root_translation holds 1 number.*NaN.*\(1, 2\)"),
        (first_frame, "holds 1 frame.*at least 2"),
        ({"fps": float("nan")}, "fps is nan, expected 0.1 to 10000"),
        ({"linear_velocity_w": np.full((3, 3, 3), 1e30)}, "1e.30 m/s, expected at most 1000 m/s"),
        ({"local_translation": np.full((3, 3), -90.0)}, "local_translation has 90 m"),
        ({"local_rotation": 1.01 * tiny_clip.local_rotation}, "'root'.*no unit.*0.01"),
        ({"parent_indices": (-1, 0, -1)}, "2 roots, expected 1"),
        ({"parent_indices": (-1, 2, 0)}, "'arm' comes before its parent"),
        ({"body_names": ("root", "arm", "arm")}, "not unique"),
        ({"root_translation": root[:2]}, r"root_translation has shape \(2, 3\), expected \(3, 3\)"),
    ):
        with pytest.raises(MotionFileError, match=f"^tiny: .*{message}") as raised:
            dataclasses.replace(tiny_clip, **changes).validate()
        assert "\n" not in str(raised.value)


def test_repeated_frames_are_dropped(tiny_clip: MotionClip) -> None:
    for frames, kept in (
        ([0, 0, 1, 1, 2], [0, 1, 2]),
        ([0, 1, 1, 2, 2], [0, 1, 2]),  # trimmed in the middle of a pair
    ):
        doubled = _take(tiny_clip, frames)
        repaired = doubled.drop_repeated_frames()
        assert repaired.fps == 5.0
        expected = _take(tiny_clip, kept)
        np.testing.assert_array_equal(repaired.local_rotation, expected.local_rotation)
        np.testing.assert_array_equal(repaired.root_translation, expected.root_translation)
        np.testing.assert_array_equal(repaired.linear_velocity_w, expected.linear_velocity_w)
        np.testing.assert_array_equal(repaired.angular_velocity_w, expected.angular_velocity_w)


def test_standing_still_for_a_while_is_no_repetition(tiny_clip: MotionClip) -> None:
    for frames in ([0, 0, 0, 0, 0], [0, 0, 1, 1, 2, 0]):
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


def clip_of(names, num_dofs=None):
    width = num_dofs or len(names)
    dofs = np.tile(np.arange(1.0, width + 1.0), (2, 1))
    return JointClip("a", 30.0, np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)), dofs, names)


def test_joints_are_ordered_by_name_and_endings_do_not_count():
    fitted = clip_of(("hip_joint", "knee_joint")).fitted_to(("knee", "hip"))
    assert fitted.dof_pos[0].tolist() == [2.0, 1.0]
    assert fitted.joint_names == ("knee", "hip")


def test_joints_of_hands_may_differ():
    fitted = clip_of(("hip", "left_hand_index_0")).fitted_to(("right_thumb", "hip"))
    assert fitted.dof_pos[0].tolist() == [0.0, 1.0]


def test_other_joints_are_listed_on_both_sides():
    with pytest.raises(MotionFileError, match="only the robot has knee; only the file has toe"):
        clip_of(("hip", "toe")).fitted_to(("hip", "knee"))
    fitted = clip_of(("hip", "toe")).fitted_to(("hip", "knee"), by_order=True)
    assert fitted.dof_pos[0].tolist() == [1.0, 2.0]


def test_without_names_the_number_counts():
    assert clip_of(None, 2).fitted_to(("a", "b")).joint_names == ("a", "b")
    with pytest.raises(MotionFileError, match="has 2 joints without names, the robot has 1"):
        clip_of(None, 2).fitted_to(("a",))


def test_degrees_are_refused():
    clip = clip_of(("hip", "knee", "wheel"))  # 1, 2 and 3 rad
    limits = np.array([[-1.0, 1.0], [0.0, 1.95], [-np.inf, np.inf]])
    clip.check_limits(limits)
    clip.check_limits(limits - np.array([[0.0], [0.2], [0.0]]))
    with pytest.raises(MotionFileError, match=r"hip exceeds .* by up to 6\.4 rad; .* degrees"):
        clip.check_limits(limits + np.array([[6.4 + 2.0], [0.0], [0.0]]))
