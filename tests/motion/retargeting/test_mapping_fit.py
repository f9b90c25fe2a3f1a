"""BVH files in other axes and units than their mapping has: read rightly, or refused in a line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.motion import convert as command
from isaacgymenvs_lite.motion.formats.npz import load_npz
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.retargeting.mapping import shipped_mappings

pytestmark = pytest.mark.usefixtures("in_an_empty_folder")

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
    assert f"usual.bvh: has the joints of mapping={rig}, which is used\n" in caplog.text
    assert f"mapping={rig}, which is used but for its own up: " in caplog.text
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
    assert "but for its own" not in caplog.text
