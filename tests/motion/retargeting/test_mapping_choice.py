"""Tests the mappings of BVH files and robots that are found by names."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion import convert as command
from isaacgymenvs_lite.motion.formats.npz import load_npz
from isaacgymenvs_lite.motion.formats.robot_clip import read_joint_clip
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping, shipped_mappings
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
    # A skeleton's mapping without its first keys is not read as a robot's mapping.
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
    assert f"dance.bvh: has the joints of mapping={rig}, which is used with up: " in caplog.text
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


Z_UP = Rotation.from_euler("x", 90, degrees=True)  # y becomes z


def heights_and_way(name: str) -> tuple[np.ndarray, float]:
    """Return the heights (T, J) m of all bodies, and how far the root travels along the ground."""
    places = load_npz(name).global_poses()[0]
    return places[..., 2], float(np.linalg.norm(places[-1, 0, :2] - places[0, 0, :2]))


@pytest.mark.parametrize(
    ("rig", "joints_too", "axes"),
    [
        ("cmu", True, Z_UP),
        ("lafan1", False, Rotation.from_euler("x", 180, degrees=True)),
    ],
)
def test_a_recognised_skeleton_in_other_axes_and_units(
    write_bvh, caplog: pytest.LogCaptureFixture, rig: str, axes: Rotation, joints_too: bool
) -> None:
    walk = load_clips("walk_slow")[0][0]
    write_bvh(Path("usual.bvh"), walk, rig)
    joint_axes = axes if joints_too else None
    write_bvh(Path("other.bvh"), walk, rig, axes=axes, joint_axes=joint_axes, unit_m=0.0254)
    with caplog.at_level("INFO"):
        for name in ("usual", "other"):
            assert command.main([f"{name}.bvh", f"{name}.npz", "end_s=0.4"]) == 0
    assert f"usual.bvh: has the joints of mapping={rig}, which is used with up: " in caplog.text
    assert f"other.bvh: has the joints of mapping={rig}, which is used with up: " in caplog.text
    assert "unit_m: 0.0254" in caplog.text
    (heights, way), (other_heights, other_way) = map(heights_and_way, ("usual.npz", "other.npz"))
    np.testing.assert_allclose(other_heights, heights, atol=2e-3)
    assert other_way == pytest.approx(way, abs=1e-3)


@pytest.mark.parametrize(
    "names",
    [
        "thigh.{s}, shin.{s}, foot.{s}, toe.{s}, upper_arm.{s}, forearm.{s}, hand.{s}",
        "{s}_Hip, {s}_Knee, {s}_Ankle, {s}_Foot, {s}_Shoulder, {s}_Elbow, {s}_Wrist",
        "B {s} Thigh, B {s} Calf, B {s} Foot, B {s} Toe0, B {s} UpperArm, B {s} Arm1, B {s} Hand",
    ],
)
def test_a_skeleton_of_other_names(write_bvh, names: str) -> None:
    """Blender, SMPL and Biped have these joint names."""
    walk = load_clips("walk_slow")[0][0]
    text = write_bvh(Path("a.bvh"), walk, "cmu", axes=Z_UP, joint_axes=Z_UP, unit_m=1.0).read_text()
    parts = ("UpLeg", "Leg", "Foot", "ToeBase", "Arm", "ForeArm", "Hand")
    for side in ("Left", "Right"):
        for part, name in zip(parts, names.format(S=side, s=side[0]).split(", "), strict=True):
            text = re.sub(rf"JOINT {side}{part}$", f"JOINT {name} ", text, flags=re.MULTILINE)
    Path("a.bvh").write_text(text.replace("JOINT LowerBack", "JOINT Spine0"))
    assert command.main(["a.bvh", "a.npz", "end_s=0.4"]) == 0
    heights = walk.global_poses()[0][: len(heights_and_way("a.npz")[0]), :, 2]
    np.testing.assert_allclose(heights_and_way("a.npz")[0], heights, atol=3e-3)


@pytest.mark.parametrize(
    ("pattern", "written", "shape", "expected"),
    [
        ("", "", {"axes": Z_UP}, r"head is above its feet along \+z, not \+y: write up: \+z"),
        ("unit_m: .*", "unit_m: 0.01", {}, r"legs are 0.14\d m long, .*: write unit_m: 0.0564"),
        ("Foot, x: .z", "Foot, x: -z", {}, r"write right_foot: {joint: RightFoot, x: \+z, z: \+y}"),
        ("Left|Right", {"Left": "Right", "Right": "Left"}, {}, "knees bend backward"),
    ],
)
def test_a_mapping_by_hand_that_does_not_fit(
    refused, write_bvh, pattern: str, written, shape: dict, expected: str
) -> None:
    write_bvh(Path("a.bvh"), load_clips("walk_slow")[0][0], "cmu", **shape)
    new = (lambda found: written[found[0]]) if isinstance(written, dict) else written
    text = shipped_mappings()["cmu"].read_text()
    Path("own.yaml").write_text(re.sub(pattern, new, text) if pattern else text)
    line = refused("a.bvh", "a.npz", "mapping=own.yaml")
    assert line.startswith("error: a.bvh does not fit mapping=own.yaml: ")
    assert re.search(expected, line)


@pytest.mark.parametrize(("rig", "about_y_deg"), [("cmu", 180.0), ("lafan1", 70.0)])
def test_who_lies_crawls_or_stands_on_the_hands_is_not_turned(
    write_bvh, make_humanoid_clip, caplog: pytest.LogCaptureFixture, rig: str, about_y_deg: float
) -> None:
    clip = make_humanoid_clip(num_frames=10)
    half = np.radians(about_y_deg) / 2
    clip.local_rotation[:, 0] = (0.0, np.sin(half), 0.0, np.cos(half))
    clip.root_translation[:, :2] += (0.7, -0.4)
    clip.root_translation[:, 2] += 0.1 - clip.global_poses()[0][..., 2].min()
    write_bvh(Path("a.bvh"), clip, rig)
    with caplog.at_level("INFO"):
        assert command.main(["a.bvh", "a.npz"]) == 0
    own = load_mapping(rig)
    assert f"with up: {own.up}, unit_m: {own.unit_m:g} and its x and z" in caplog.text


def test_a_bvh_file_becomes_a_clip(write_bvh, caplog: pytest.LogCaptureFixture) -> None:
    write_bvh(Path("dance.bvh"), load_clips("walk_slow")[0][0], "cmu")
    own = Path("own.yaml")
    own.write_text(shipped_mappings()["cmu"].read_text())
    with caplog.at_level("INFO"):
        command.main(["dance.bvh", "dance.npz", "mapping=own.yaml", "end_s=1", "fps=15"])
    assert load_npz("dance.npz").num_frames == 16
    assert "left_foot 0.000" in caplog.text


def test_a_rest_pose_at_the_start_is_told(write_bvh, caplog: pytest.LogCaptureFixture) -> None:
    """The first frame has no rotations, as in CMU's files."""
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
