from __future__ import annotations

import numpy as np
import PIL.Image
import pytest

from isaacgymenvs_lite.motion import plot
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.skeleton import skeleton_for_num_dofs


def test_a_plot_is_written(tmp_path):
    out = tmp_path / "walk.png"
    assert plot.main(["walk", f"out={out}"]) == 0
    with PIL.Image.open(out) as image:
        picture = np.array(image.convert("RGB")).astype(int)
    assert (picture.max(axis=2) - picture.min(axis=2) > 60).mean() > 0.01  # coloured lines


def test_angles_are_those_of_the_clip(walk_clip):
    clip = load_clips(walk_clip)[0][0]
    angles = plot.joint_angles(clip, skeleton_for_num_dofs(28))
    assert len(angles) == 12  # eight ball joints and four hinges
    # The right shin of this clip bends by 0.5 + 0.2 sin(2 pi t / 1.2).
    swing = 0.2 * np.sin(2.0 * np.pi * np.arange(46) / 30.0 / 1.2)
    np.testing.assert_allclose(angles["right_shin"], 0.5 + swing, atol=1e-5)
    assert min(angle.min() for name, angle in angles.items() if "thigh" in name) >= 0.0


def test_feet_of_a_walk_stand_in_turns():
    contacts = plot.foot_contacts(load_clips("walk")[0][0])
    assert sorted(contacts) == ["left_foot", "right_foot"]
    left, right = contacts["left_foot"], contacts["right_foot"]
    assert 0.4 < left.mean() < 0.75  # about three fifths of a cycle of a walk
    assert 0.4 < right.mean() < 0.75
    assert (left ^ right).mean() > 0.3
    stand = plot.foot_contacts(load_clips("stand")[0][0])
    assert all(foot.all() for foot in stand.values())


def test_a_mistake_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        plot.main(["walk", "out=x.abc"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.strip().startswith("error: ")
