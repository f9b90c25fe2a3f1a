"""DeepMimic's format: a clip comes back as it was, in the places that the format has."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.deepmimic import load_deepmimic, save_deepmimic
from isaacgymenvs_lite.motion.loader import load_clips


@pytest.mark.parametrize("name", ["walk", "turn_left", "jump"])
def test_round_trip(tmp_path: Path, humanoid, name: str) -> None:
    clip = load_clips(name)[0][0]
    again = load_deepmimic(save_deepmimic(tmp_path / "clip.txt", clip), humanoid)
    # Numbers are stored to 1e-9, the clips are float32 (6e-8), quaternions are normalised.
    assert again.fps == pytest.approx(clip.fps, rel=1e-6)
    np.testing.assert_allclose(again.global_poses()[0], clip.global_poses()[0], atol=2e-6)


def test_a_hinge_turns_the_other_way(tmp_path: Path, humanoid, make_humanoid_clip, about) -> None:
    clip = make_humanoid_clip(num_frames=3)
    clip.local_rotation[:, humanoid.body_names.index("right_shin")] = about("y", [0.5] * 3)
    rows = json.loads(save_deepmimic(tmp_path / "clip.txt", clip).read_text())["Frames"]
    assert [row[20] for row in rows] == pytest.approx([-0.5] * 3)
    assert rows[0][0] == pytest.approx(1 / 30)
    assert rows[0][2] == pytest.approx(0.9)  # y is up


def test_the_armed_humanoid_loses_its_hand_only(
    tmp_path: Path, armed, make_humanoid_clip, about
) -> None:
    clip = make_humanoid_clip(num_frames=3, skeleton=armed)
    clip.local_rotation[:, armed.body_names.index("right_hand")] = about("x", [0.3] * 3)
    clip.local_rotation[:, armed.body_names.index("torso")] = about("z", [0.2] * 3)
    again = load_deepmimic(save_deepmimic(tmp_path / "clip.txt", clip), armed)
    lost = armed.body_names.index("right_hand")
    others = [body for body in range(armed.num_bodies) if body != lost]
    np.testing.assert_allclose(again.local_rotation[:, others], clip.local_rotation[:, others])
    np.testing.assert_array_equal(again.local_rotation[:, lost], [[0.0, 0.0, 0.0, 1.0]] * 3)


def test_another_body_is_refused(tmp_path: Path, tiny_clip) -> None:
    with pytest.raises(MotionFileError, match=r"tiny: has no torso, head, .*, which DeepMimic"):
        save_deepmimic(tmp_path / "clip.txt", tiny_clip)
    assert not list(tmp_path.iterdir())
