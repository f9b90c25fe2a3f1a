"""Targets of a source motion: size, ground, soles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.retargeting.bvh import read_bvh
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping
from isaacgymenvs_lite.motion.retargeting.source import humanoid_figure, source_from_bvh
from isaacgymenvs_lite.motion.retargeting.targets import make_targets


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
