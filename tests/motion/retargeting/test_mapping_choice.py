"""Mappings of BVH files and robots that are found by names, and what they are mixed up with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion import convert as command
from isaacgymenvs_lite.motion.formats.robot_clip import read_joint_clip
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.retargeting.mapping import shipped_mappings
from isaacgymenvs_lite.motion.retargeting.mapping_choice import read_named_mappings
from isaacgymenvs_lite.motion.retargeting.robot_mapping import shipped_robot_mappings

G1 = "robot=mjcf/g1.xml"

pytestmark = pytest.mark.usefixtures("in_an_empty_folder")


def convert(*words: str) -> None:
    assert command.main(list(words)) == 0


def test_the_keys_of_a_file_tell_its_kind() -> None:
    skeletons, robots = shipped_mappings(), shipped_robot_mappings()
    Path("a.yaml").write_text(skeletons["cmu"].read_text())
    Path("b.yaml").write_text(robots["g1"].read_text())
    for given in ("a.yaml,b.yaml", "b.yaml, a.yaml"):
        skeleton, robot = read_named_mappings(given)
        assert skeleton is not None
        assert robot is not None
        assert (skeleton.name, robot.name) == ("a.yaml", "b.yaml")
    assert read_named_mappings("") == (None, None)
    # A mapping of a skeleton without its first keys is not taken for one of a robot.
    Path("c.yaml").write_text("bodies: {pelvis: {joint: Hips, x: +z, z: +y}}")
    with pytest.raises(ConfigError, match=r"'c\.yaml\.up' is missing"):
        read_named_mappings("c.yaml")
    with pytest.raises(ConfigError, match=r"b\.yaml,g1: has two mappings of a robot"):
        read_named_mappings("b.yaml,g1")


def test_motion_capture_moves_a_robot(write_bvh, caplog) -> None:
    rig = "cmu"
    write_bvh(Path("dance.bvh"), load_clips("walk_slow")[0][0], rig)
    with caplog.at_level("INFO"):
        convert("dance.bvh", "found.npz", G1, "end_s=0.2")
    assert f"dance.bvh: has the joints of mapping={rig}, which is used\n" in caplog.text
    own = Path("own.yaml")
    own.write_text(shipped_robot_mappings()["g1"].read_text())
    for mapping in ("own.yaml", f"{rig},g1"):
        convert("dance.bvh", "a.npz", G1, "end_s=0.2", f"mapping={mapping}", "overwrite=True")
        found, same = read_joint_clip("found.npz"), read_joint_clip("a.npz")
        np.testing.assert_array_equal(found.dof_pos, same.dof_pos)


def test_motion_capture_moves_the_humanoid_without_a_mapping(write_bvh) -> None:
    write_bvh(Path("dance.bvh"), load_clips("walk_slow")[0][0], "lafan1")
    convert("dance.bvh", "a.npz", "end_s=0.2")
    convert("dance.bvh", "b.npz", "end_s=0.2", "mapping=lafan1")
    assert Path("a.npz").read_bytes() == Path("b.npz").read_bytes()


def test_unknown_joints_need_a_mapping(refused, write_bvh) -> None:
    path = write_bvh(Path("dance.bvh"), load_clips("walk_slow")[0][0], "cmu")
    path.write_text(path.read_text().replace("JOINT LeftFoot", "JOINT LeftPaw"))
    line = refused("dance.bvh", "a.npz", G1)
    assert "has the joints of no shipped mapping (Hips, LHipJoint" in line
    assert "give mapping=, one of cmu, lafan1 or a YAML file" in line
