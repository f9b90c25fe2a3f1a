"""Tests the BVH reader against another program's kinematics, and messages about mistakes."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.errors import MissingPackageError, MotionFileError
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.retargeting.bvh import read_bvh
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping


@pytest.fixture
def walk_file(tmp_path: Path, write_bvh) -> Path:
    return write_bvh(tmp_path / "walk.bvh", load_clips("walk_slow")[0][0], "lafan1")


def read(path: Path, mapping: str = "lafan1"):
    chosen = load_mapping(mapping)
    return read_bvh(path).clip(chosen.to_z_up, chosen.unit_m), chosen


@pytest.mark.parametrize(("rig", "order"), [("cmu", ""), ("lafan1", "XYZ")])
def test_joints_are_where_the_bodies_were(tmp_path: Path, write_bvh, rig, order) -> None:
    clip = load_clips("walk_slow")[0][0]
    path = write_bvh(tmp_path / "walk.bvh", clip, rig, order=order)
    motion, mapping = read(path, rig)
    assert motion.fps == clip.fps
    expected, places = clip.global_poses()[0], motion.global_poses()[0]
    for i, body in enumerate(clip.body_names):
        joint = motion.body_names.index(mapping.sources[body].joint)
        # The file has six decimals, in degrees and in its unit: 1e-8 of 1 m each.
        np.testing.assert_allclose(places[:, joint], expected[:, i], atol=1e-6)


def test_position_channels_may_stand_last(walk_file: Path) -> None:
    before = read(walk_file)[0]
    text = walk_file.read_text()
    places, turns = "Xposition Yposition Zposition", "Zrotation Yrotation Xrotation"
    head, rows = text.replace(f"{places} {turns}", f"{turns} {places}").split("Frame Time")
    lines = rows.splitlines()
    for i, line in enumerate(lines[1:], 1):
        values = line.split()
        lines[i] = " ".join(values[3:6] + values[:3] + values[6:])
    walk_file.write_text("Frame Time".join((head, "\n".join(lines))))
    np.testing.assert_allclose(read(walk_file)[0].global_poses()[0], before.global_poses()[0])


def with_all_positions(text: str, places) -> str:
    """Give all joints position channels; `places(offset, frame)` returns their values."""
    head, rows = text.split("MOTION\n")
    offsets = [
        np.array(found[1].split(), dtype=float)
        for found in re.finditer(r"OFFSET (.*)\n\s*CHANNELS 3", head)
    ]
    head = head.replace("CHANNELS 3 Z", "CHANNELS 6 Xposition Yposition Zposition Z")
    lines = rows.splitlines()
    for i, line in enumerate(lines[2:], 2):
        values = line.split()
        turns = [" ".join(values[6 + 3 * k : 9 + 3 * k]) for k in range(len(offsets))]
        inner = (
            " ".join(map(str, places(offset, i))) + f" {turn}"
            for offset, turn in zip(offsets, turns, strict=True)
        )
        lines[i] = " ".join([*values[:6], *inner])
    return "MOTION\n".join((head, "\n".join(lines)))


def test_positions_of_all_joints_that_stay_the_same(walk_file: Path) -> None:
    before, text = read(walk_file)[0], walk_file.read_text()
    for places in (lambda offset, frame: offset, lambda offset, frame: (0, 0, 0)):
        walk_file.write_text(with_all_positions(text, places))
        assert walk_file.read_text().count("CHANNELS 6") > 20
        after = read(walk_file)[0]
        np.testing.assert_allclose(after.global_poses()[0], before.global_poses()[0], atol=1e-6)


def test_positions_that_are_other_offsets_count(walk_file: Path) -> None:
    before = read(walk_file)[0]
    text = with_all_positions(walk_file.read_text(), lambda offset, frame: 1.1 * offset)
    walk_file.write_text(text)
    after = read(walk_file)[0]
    np.testing.assert_allclose(
        after.local_translation[1:], 1.1 * before.local_translation[1:], atol=1e-6
    )


def below_other_joints(text: str, rotate_root: float, root_channels: str, sway: float) -> str:
    """Add two joints above the hips without changing the hips' motion.

    Args:
        text: of a file of LAFAN1's skeleton.
        rotate_root: degrees about x, of the new ROOT, which stands still.
        root_channels: of the new ROOT.
        sway: degrees about y, by which the joint below it turns to and fro, with its offset.
    """
    head, rows = text.split("MOTION\n")
    motion = rows.splitlines()
    above = f"""HIERARCHY
ROOT Root
{{
OFFSET 1 2 3
CHANNELS {root_channels}
JOINT Reference
{{
OFFSET 10 20 30
CHANNELS 3 Yrotation Xrotation Zrotation
JOINT Hips"""
    head = head.replace("HIERARCHY\nROOT Hips", above) + "}\n}\n"
    root = Rotation.from_euler("X", rotate_root, degrees=True)
    first = [rotate_root if name == "Xrotation" else 0.0 for name in root_channels.split()[1:]]
    for i, line in enumerate(motion[2:], 2):
        values = np.array(line.split(), dtype=float)
        turn = root * Rotation.from_euler("Y", sway * np.sin(i), degrees=True)
        place = turn.inv().apply(values[:3] - np.array((1.0, 2.0, 3.0)) - root.apply((10, 20, 30)))
        hips = turn.inv() * Rotation.from_euler("ZYX", values[3:6], degrees=True)
        inner = (sway * np.sin(i), 0.0, 0.0, *place, *hips.as_euler("ZYX", degrees=True))
        motion[i] = " ".join(f"{x:.9f}" for x in (*first, *inner, *values[6:]))
    return "MOTION\n".join((head, "\n".join(motion)))


@pytest.mark.parametrize(
    ("rotate_root", "root_channels", "sway"),
    [
        (-90.0, "6 Zrotation Yrotation Xrotation Zposition Xposition Yposition", 40.0),
        (0.0, "0", 25.0),
    ],
)
def test_joints_above_the_hips_are_part_of_the_roots_motion(
    walk_file: Path, write_bvh, rotate_root: float, root_channels: str, sway: float
) -> None:
    """The ROOT stands still in files of BONES-SEED, SOMA and Bandai-Namco."""
    before, mapping = read(walk_file)
    text = below_other_joints(walk_file.read_text(), rotate_root, root_channels, sway)
    walk_file.write_text(text)
    joints = [source.joint for source in mapping.sources.values()]
    after = read_bvh(walk_file, joints).clip(mapping.to_z_up, mapping.unit_m)
    assert after.body_names == before.body_names
    (places, turns), (before_places, before_turns) = after.global_poses(), before.global_poses()
    np.testing.assert_allclose(places, before_places, atol=1e-6)
    np.testing.assert_allclose(np.abs((turns * before_turns).sum(axis=-1)), 1.0, atol=1e-9)


def test_windows_line_ends(walk_file: Path) -> None:
    before = read(walk_file)[0]
    walk_file.write_bytes(walk_file.read_bytes().replace(b"\n", b"\r\n"))
    np.testing.assert_array_equal(read(walk_file)[0].local_rotation, before.local_rotation)


def drop_last_value(text: str) -> str:
    return text.rstrip().rsplit(" ", 1)[0] + "\n"


def test_damaged_files_are_one_line(walk_file: Path, tmp_path: Path) -> None:
    text = walk_file.read_text()
    moving = with_all_positions(text, lambda offset, frame: (1 + frame / 50) * offset)
    constant = with_all_positions(text, lambda offset, frame: offset)
    cannot = "no BVH file that can be read"
    for damaged, message in (
        ("", "it has no joints"),
        (text[: len(text) // 2], cannot),
        ("\n".join(text.splitlines()[:-3]), "declares 109 frames but .* 106"),
        (text.replace("CHANNELS 3 Z", "CHANNELS 4 Z", 1), "declares 4 channels"),
        (text[: text.rindex("\n", 0, -1)] + "\n" + "nan " * 69, "NaN or infinite"),
        (moving, r"joint \w+ moves within its parent by [\d.]+ units"),
        (drop_last_value(constant), cannot),
        (constant[: constant.index("MOTION")] + "MOTION", "no frames after 'MOTION'"),
    ):
        walk_file.write_text(damaged)
        with pytest.raises(MotionFileError, match=message) as caught:
            read(walk_file)
        assert str(caught.value).startswith(str(walk_file))
        assert "\n" not in str(caught.value)
    with pytest.raises(MotionFileError, match=r"none\.bvh: no such file"):
        read(tmp_path / "none.bvh")


def test_a_missing_library_names_the_extra(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"needs the package pybvh.*lite\[retarget\]"):
        read(tmp_path / "clip.bvh")
