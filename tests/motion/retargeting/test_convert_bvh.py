"""The command that converts clips, with motion capture of other skeletons."""

from __future__ import annotations

from pathlib import Path

import pytest

from isaacgymenvs_lite.motion import convert as command
from isaacgymenvs_lite.motion.formats.npz import load_npz
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.retargeting.mapping import shipped_mappings

pytestmark = pytest.mark.usefixtures("in_an_empty_folder")


def test_a_bvh_file_becomes_a_clip(write_bvh, caplog: pytest.LogCaptureFixture) -> None:
    write_bvh(Path("dance.bvh"), load_clips("walk_slow")[0][0], "cmu")
    own = Path("own.yaml")
    own.write_text(shipped_mappings()["cmu"].read_text())
    with caplog.at_level("INFO"):
        command.main(["dance.bvh", "dance.npz", "mapping=own.yaml", "end_s=1", "fps=15"])
    assert load_npz("dance.npz").num_frames == 16
    assert "left_foot 0.000" in caplog.text


def test_a_rest_pose_at_the_start_is_told(write_bvh, caplog: pytest.LogCaptureFixture) -> None:
    """As CMU's files begin: a first frame without rotations, then the motion."""
    path = write_bvh(Path("run.bvh"), load_clips("run")[0][0], "cmu")
    command.main(["run.bvh", "a.npz", "mapping=cmu"])
    assert "rest pose" not in caplog.text
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    values = lines[first].split()
    lines[first] = " ".join([*values[:3], *["0"] * (len(values) - 3)])
    path.write_text("\n".join(lines))
    command.main(["run.bvh", "b.npz", "mapping=cmu"])
    assert "maybe it is the rest pose; start_s=0.0167 leaves it out" in caplog.text
    caplog.clear()
    command.main(["run.bvh", "c.npz", "mapping=cmu", "start_s=0.0167"])
    assert "rest pose" not in caplog.text


def test_the_wrong_skeleton_lists_the_joints(refused, write_bvh) -> None:
    write_bvh(Path("dance.bvh"), load_clips("walk_slow")[0][0], "cmu")
    line = refused("dance.bvh", "a.npz", "mapping=lafan1")
    assert "unknown joint 'Spine2' (did you mean 'Spine" in line
    assert "choices: Head, Hips" in line
