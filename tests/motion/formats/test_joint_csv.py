"""Tests tables of joint angles: their content, and the messages about mistakes."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.joint_csv import load_joint_csv, save_joint_csv
from isaacgymenvs_lite.motion.loader import load_clips


@pytest.fixture
def table(tmp_path: Path, make_humanoid_clip, humanoid) -> Path:
    return save_joint_csv(tmp_path / "clip.csv", make_humanoid_clip(num_frames=4), humanoid)


def edited(path: Path, column: str, new: str, change=lambda text: text) -> Path:
    """Rename a column of the table and change its values."""
    rows = list(csv.reader(path.read_text().splitlines()))
    index = rows[0].index(column)
    rows[0][index] = new
    for row in rows[1:]:
        row[index] = change(row[index])
    path.write_text("\n".join(",".join(row) for row in rows))
    return path


def test_round_trip(tmp_path: Path, humanoid) -> None:
    clip = load_clips("jump")[0][0]
    again = load_joint_csv(save_joint_csv(tmp_path / "clip.csv", clip, humanoid), [humanoid])
    assert again.fps == pytest.approx(clip.fps, rel=1e-9)
    # 12 digits are stored; the clip's quaternions are float32 and not exactly of unit length.
    np.testing.assert_allclose(again.global_poses()[0], clip.global_poses()[0], atol=2e-6)


def test_round_trip_of_the_armed_humanoid(tmp_path, humanoid, armed, make_humanoid_clip, about):
    clip = make_humanoid_clip(num_frames=3, skeleton=armed)
    clip.local_rotation[:, armed.body_names.index("right_hand")] = about("x", [0.3, 0.4, 0.5])
    path = save_joint_csv(tmp_path / "clip.csv", clip, armed)
    again = load_joint_csv(path, [humanoid, armed])  # distinguished by the columns
    np.testing.assert_allclose(again.local_rotation, clip.local_rotation, atol=1e-11)


def test_the_header_names_units(table: Path) -> None:
    header = table.read_text().splitlines()[0].split(",")
    assert header[:8] == [
        *("time [s]", "root_x [m]", "root_y [m]", "root_z [m]"),
        *("root_qx", "root_qy", "root_qz", "root_qw"),
    ]
    assert header[8] == "abdomen_x [rad]"
    assert header[17] == "right_elbow [rad]"
    assert len(header) == 8 + 28


def test_degrees_and_centimetres(table: Path, humanoid) -> None:
    edited(table, "right_knee [rad]", "right_knee [deg]", lambda _: "90")
    edited(table, "root_z [m]", "root_z [cm]", lambda _: "90")
    clip = load_joint_csv(table, [humanoid])
    shin = clip.local_rotation[0, humanoid.body_names.index("right_shin")]
    np.testing.assert_allclose(shin, [0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    assert clip.root_translation[0, 2] == pytest.approx(0.9)


def test_a_rate_in_place_of_times(table: Path, humanoid) -> None:
    lines = [line.split(",", 1)[1] for line in table.read_text().splitlines()]
    table.write_text("\n".join(["# fps: 25", *lines]))
    assert load_joint_csv(table, [humanoid]).fps == 25.0
    table.write_text("\n".join(lines))
    with pytest.raises(MotionFileError, match=r"no column 'time \[s\]'; add one, or .*# fps: 30"):
        load_joint_csv(table, [humanoid])


def test_mistakes_are_one_line(table: Path, humanoid) -> None:
    knee, right = "right_knee [rad]", table.read_text()
    for column, new, value, message in (
        (knee, "right_nee [rad]", None, r"'right_nee' \(did you mean 'right_knee'"),
        (knee, "right_knee", None, r"has no unit; choices: 'right_knee \[rad\]', "),
        (knee, "left_knee [rad]", None, "names left_knee twice"),
        (knee, knee, "nan", "row 1 holds NaN"),
        (knee, knee, "1,2", "row 1 has 37 values, expected 36"),
        ("time [s]", "time [s]", "1", "the time steps are 0 to 0 s, expected equal steps above 0"),
        ("root_qw", "root_qw", "0.5", "'pelvis' in frame 0 is no unit quaternion"),
    ):
        table.write_text(right)
        edited(table, column, new, lambda text, value=value: value or text)
        with pytest.raises(MotionFileError, match=message) as caught:
            load_joint_csv(table, [humanoid])
        assert "\n" not in str(caught.value)
    for text, message in (
        ("time [s],root_x [m]\n0,0\n1,0\n", r"lacks root_y, root_z, root_qx.*left_ankle_z"),
        ("", r"holds 0 line\(s\), expected a header"),
    ):
        table.write_text(text)
        with pytest.raises(MotionFileError, match=message):
            load_joint_csv(table, [humanoid])
