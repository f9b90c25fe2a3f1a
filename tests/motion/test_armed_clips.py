"""Clips with sword and shield, in ASE's format: 17 bodies, float64 fps that is not whole."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.motion.skeleton import Skeleton

FPS = 29.86
RIGHT_HAND, SWORD, LEFT_UPPER_ARM, SHIELD, LEFT_HAND, LEFT_FOOT = 5, 6, 7, 9, 10, 16
# right_hand, left_hand, right_foot, left_foot, sword, shield
KEY_BODIES = [5, 10, 13, 16, 6, 9]
# Rotation vectors and positions come from float32 quaternions.
ATOL = 3e-6


@pytest.fixture
def lib(
    tmp_path: Path, armed: Skeleton, make_humanoid_clip, about, as_poselib, save_object_npy
) -> MotionLib:
    """Three frames: the right hand turns about z, the left arm about x, the left foot about y."""
    clip = make_humanoid_clip(num_frames=3, skeleton=armed)
    clip.local_rotation[:, RIGHT_HAND] = about("z", [0.0, 0.2, 0.4])
    clip.local_rotation[:, LEFT_UPPER_ARM] = about("x", [0.0, 0.3, 0.6])
    clip.local_rotation[:, LEFT_FOOT] = about("y", [0.0, -0.1, -0.2])
    data = as_poselib(clip) | {"fps": np.float64(FPS)}
    path = save_object_npy(tmp_path / "strike.npy", data)
    return MotionLib(path, 31, KEY_BODIES, "cpu")


def test_every_joint_has_its_place_among_the_31_dofs(lib: MotionLib) -> None:
    # Half way between frames 1 and 2.
    state = lib.get_motion_state([0], torch.tensor([1.5 / FPS], dtype=torch.float64))
    dof_pos, dof_vel = np.zeros((2, 31))
    dof_pos[12], dof_vel[12] = 0.3, 0.2 * FPS  # right_hand_z
    dof_pos[13], dof_vel[13] = 0.45, 0.3 * FPS  # left_shoulder_x
    dof_pos[29], dof_vel[29] = -0.15, -0.1 * FPS  # left_ankle_y
    np.testing.assert_allclose(state.dof_pos, [dof_pos], atol=ATOL)
    # Differences over 1/30 s of float32 quaternions.
    np.testing.assert_allclose(state.dof_vel, [dof_vel], atol=ATOL * 2 * FPS)


def test_sword_and_shield_follow_the_arms(lib: MotionLib) -> None:
    keys = lib.get_motion_state([0], [2 / FPS]).key_pos[0].numpy()
    right_hand, left_hand, sword, shield = keys[[0, 1, 4, 5]]
    # The tip of the blade is 0.74 m in front of the hand, which has turned by 0.4 rad to the left.
    np.testing.assert_allclose(
        sword - right_hand, [0.74 * np.cos(0.4), 0.74 * np.sin(0.4), 0.0], atol=ATOL
    )
    # From the shield to the hand: (0, -0.07, -0.138947) m, turned by 0.6 rad about x.
    y, z = -0.07, 0.12 - 0.258947
    turned = [0.0, y * np.cos(0.6) - z * np.sin(0.6), y * np.sin(0.6) + z * np.cos(0.6)]
    np.testing.assert_allclose(left_hand - shield, turned, atol=ATOL)


def test_order_of_the_file_does_not_count(
    tmp_path: Path, armed: Skeleton, make_humanoid_clip, about, as_poselib, save_object_npy
) -> None:
    clip = make_humanoid_clip(num_frames=3, skeleton=armed)
    clip.local_rotation[:, RIGHT_HAND] = about("z", [0.0, 0.2, 0.4])
    # The hand before the shield, both children of the left lower arm.
    order = list(range(17))
    order[SHIELD], order[LEFT_HAND] = LEFT_HAND, SHIELD
    swapped = dataclasses.replace(
        clip,
        body_names=tuple(clip.body_names[i] for i in order),
        local_translation=clip.local_translation[order],
    )
    libs = [
        MotionLib(save_object_npy(tmp_path / f"{i}.npy", as_poselib(c)), 31, KEY_BODIES, "cpu")
        for i, c in enumerate((clip, swapped))
    ]
    states = [lib.get_motion_state([0], [0.05]) for lib in libs]
    for one, other in zip(*states, strict=True):
        np.testing.assert_array_equal(one, other)
