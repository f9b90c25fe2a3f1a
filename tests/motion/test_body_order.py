import dataclasses
import logging

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.loader import fit_to_skeleton
from isaacgymenvs_lite.motion.skeleton import Skeleton

LEFT_LEG_FIRST = [*range(9), 12, 13, 14, 9, 10, 11]


def _marked(clip: MotionClip) -> MotionClip:
    """Give every body its own velocity, so that a wrong order shows."""
    velocity = np.zeros((clip.num_frames, clip.num_bodies, 3))
    velocity[..., 0] = np.arange(clip.num_bodies)
    return dataclasses.replace(clip, linear_velocity_w=velocity, angular_velocity_w=-velocity)


def test_bodies_are_brought_into_order(humanoid: Skeleton, make_humanoid_clip, about) -> None:
    ordered = _marked(make_humanoid_clip(num_frames=3))
    ordered.local_rotation[:, 12] = about("x", [0.1, 0.2, 0.3])  # left thigh
    order = LEFT_LEG_FIRST
    shuffled = dataclasses.replace(
        ordered,
        body_names=tuple(ordered.body_names[i] for i in order),
        parent_indices=(-1, 0, 1, 1, 3, 4, 1, 6, 7, 0, 9, 10, 0, 12, 13),
        local_translation=ordered.local_translation[order],
        local_rotation=ordered.local_rotation[:, order],
        linear_velocity_w=ordered.linear_velocity_w[:, order],
        angular_velocity_w=ordered.angular_velocity_w[:, order],
    )
    fitted = fit_to_skeleton(shuffled, humanoid)
    assert fitted.body_names == ordered.body_names
    assert fitted.parent_indices == ordered.parent_indices
    for name in (
        "local_translation",
        "local_rotation",
        "linear_velocity_w",
        "angular_velocity_w",
    ):
        np.testing.assert_array_equal(getattr(fitted, name), getattr(ordered, name), err_msg=name)


def test_other_bodies_are_named(humanoid: Skeleton, make_humanoid_clip) -> None:
    names = tuple("sword" if name == "head" else name for name in humanoid.body_names)
    clip = make_humanoid_clip(body_names=names)
    message = (
        "walk.npz: its skeleton lacks head and also has sword; expected the 15 bodies of the "
        "humanoid: pelvis, .*, left_foot; use a clip of this humanoid$"
    )
    with pytest.raises(MotionFileError, match=message):
        fit_to_skeleton(clip, humanoid)


def test_clip_of_the_other_humanoid_names_that_one(armed: Skeleton, make_humanoid_clip) -> None:
    what = r"walk\.npz: its skeleton lacks sword, shield;"
    with pytest.raises(MotionFileError, match=what) as raised:
        fit_to_skeleton(make_humanoid_clip(), armed)
    todo = "use task.env.asset.assetFileName=mjcf/amp_humanoid.xml or another clip"
    assert str(raised.value).endswith(todo)


def test_largest_hinge_violation_is_reported(
    humanoid: Skeleton, make_humanoid_clip, about, caplog
) -> None:
    clip = make_humanoid_clip(num_frames=4)
    clip.local_rotation[:, 10] = about("y", [0.0, 0.5, 1.0, 1.5])  # a right knee that bends
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(clip, humanoid)
    assert caplog.text == ""
    clip.local_rotation[:, 13] = about("x", [0.0, 0.1, 0.2, 0.1])  # a left knee that twists
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(clip, humanoid)
    (record,) = caplog.records
    message = record.getMessage()
    assert "'left_shin' is a hinge about (0, 1, 0) but turns 0.200 rad" in message
    assert "in frame 2" in message


def test_other_dimensions_are_reported(humanoid: Skeleton, make_humanoid_clip, caplog) -> None:
    offsets = humanoid.local_translation.copy()
    offsets[0] += 5.0  # where the character stood in its file plays no part
    offsets[1] += 1e-4  # rounding in the file
    clip = make_humanoid_clip(local_translation=offsets)
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(clip, humanoid)
    assert caplog.text == ""
    offsets[10, 2] -= 0.05
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(make_humanoid_clip(local_translation=offsets), humanoid)
    assert "the offset of 'right_shin' differs by 0.050 m" in caplog.text


def test_speeds_and_places_that_are_doubtful_are_reported(
    humanoid: Skeleton, make_humanoid_clip, caplog
) -> None:
    clip = make_humanoid_clip()
    fast, far = clip.linear_velocity_w.copy(), clip.root_translation.copy()
    fast[1, 2, 0], far[:, 1] = 80.0, 2_000.0
    clip = dataclasses.replace(clip, linear_velocity_w=fast, root_translation=far)
    fit_to_skeleton(clip, humanoid)
    assert "a body moves at up to 80 m/s" in caplog.text
    assert "the root is up to 2000 m from the origin" in caplog.text
