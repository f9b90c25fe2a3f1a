"""Files are written here with csv text, pickle and numpy alone, not with the project's writers."""

from __future__ import annotations

import os
import pickle

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.robot_clip import looks_like_joint_clip, read_joint_clip
from isaacgymenvs_lite.motion.formats.robot_csv import save_robot_csv
from isaacgymenvs_lite.motion.formats.robot_npz import save_robot_npz
from isaacgymenvs_lite.motion.joint_clip import JointClip

YAW = np.array([0.0, 0.0, np.sin(0.2), np.cos(0.2)])


def arrays(num_dofs, frames=4):
    position = np.linspace([0.0, 0.0, 0.8], [0.1, 0.0, 0.8], frames)
    dofs = np.linspace(0.0, 0.1, frames)[:, None] + 0.01 * np.arange(num_dofs)
    return position, np.tile(YAW, (frames, 1)), dofs


def write_rows(path, table, header=""):
    text = "\n".join(",".join(repr(float(v)) for v in row) for row in table)
    path.write_text(header + text + "\n")
    return path


def check(clip, expected, fps):
    assert clip.fps == pytest.approx(fps)
    for found, wanted in zip((clip.root_pos, clip.root_rot, clip.dof_pos), expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize(
    ("num_dofs", "number", "name"),
    [
        (29, 12, "waist_yaw_joint"),
        (27, 1, "left_hip_pitch_joint"),
        (19, 14, "left_elbow_joint"),
        (12, 0, None),
    ],
)
def test_unitrees_table(tmp_path, num_dofs, number, name):
    path = write_rows(tmp_path / "a.csv", np.hstack(arrays(num_dofs)))
    clip = read_joint_clip(path)
    check(clip, arrays(num_dofs), 30.0)
    assert (clip.joint_names and clip.joint_names[number]) == name
    assert looks_like_joint_clip(path)
    assert read_joint_clip(path, fps=60.0).fps == 60.0


def test_bones_seed_is_in_cm_and_degrees(tmp_path):
    header = (
        "Frame,root_translateX,root_translateY,root_translateZ,root_rotateX,root_rotateY,"
        "root_rotateZ,left_knee_joint_dof\n"
    )
    rows = [[i, 100.0, 0.0, 80.0, 0.0, 90.0, 90.0, 45.0] for i in range(3)]
    clip = read_joint_clip(write_rows(tmp_path / "a.csv", rows, header))
    assert clip.joint_names == ("left_knee_joint",)
    # By hand: Rz(90 deg) Ry(90 deg) = (-0.5, 0.5, 0.5, 0.5) as xyzw.
    wanted = ([[1.0, 0.0, 0.8]] * 3, [[-0.5, 0.5, 0.5, 0.5]] * 3, [[np.pi / 4]] * 3)
    check(clip, wanted, 120.0)
    with pytest.raises(MotionFileError, match="frames are missing"):
        read_joint_clip(write_rows(tmp_path / "b.csv", [rows[0], rows[2]], header))


def write_pickle(path, data, protocol=4, numpy_1=False):
    content = pickle.dumps(data, protocol=protocol)
    if numpy_1:  # protocol 3 has the names of modules on lines of their own
        content = content.replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(("protocol", "numpy_1"), [(4, False), (3, True)])
def test_gmr(tmp_path, protocol, numpy_1):
    keys = ("root_pos", "root_rot", "dof_pos")
    data = {"fps": 50, **dict(zip(keys, arrays(6), strict=True)), "local_body_pos": None}
    path = write_pickle(tmp_path / "a.pkl", data, protocol, numpy_1)
    check(read_joint_clip(path), arrays(6), 50.0)
    assert looks_like_joint_clip(path)


def test_mimickit(tmp_path):
    position, _, dofs = arrays(6)
    exp_map = np.tile([0.0, 0.0, 0.4], (4, 1))  # YAW has half of this angle
    frames = np.hstack((position, exp_map, dofs)).tolist()
    path = write_pickle(tmp_path / "a.pkl", {"fps": 30, "loop_mode": 0, "frames": frames})
    check(read_joint_clip(path), arrays(6), 30.0)


def test_code_in_a_pickle_is_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'canary'}",)

    path = write_pickle(tmp_path / "a.pkl", {"fps": 30, "frames": Evil()})
    with pytest.raises(MotionFileError, match="refused, nothing was run"):
        read_joint_clip(path)
    assert not (tmp_path / "canary").exists()


@pytest.mark.parametrize("mirror", [2, 7])
@pytest.mark.parametrize("world", [0, 1])
def test_tracking_archive_shows_its_order(tmp_path, mirror, world):
    position, rotation, dofs = arrays(29)
    bodies = position[:, None] + 0.01 * np.arange(30)[:, None] * [1.0, 0.0, 0.0]
    bodies[:, 1] = position + np.array([0.0, 0.06, -0.1])
    bodies[:, mirror] = position + np.array([0.0, -0.06, -0.1])
    quaternions = np.repeat(np.roll(rotation, 1, axis=1)[:, None], 30, axis=1)
    if world:
        bodies = np.insert(bodies, 0, 0.0, axis=1)
        quaternions = np.insert(quaternions, 0, [1.0, 0.0, 0.0, 0.0], axis=1)
    path = tmp_path / "a.npz"
    np.savez(path, fps=[50], joint_pos=dofs, body_pos_w=bodies, body_quat_w=quaternions)
    clip = read_joint_clip(path)
    check(clip, arrays(29), 50.0)
    wanted = {2: "right_hip_pitch_joint", 7: "left_hip_roll_joint"}
    assert clip.joint_names is not None and clip.joint_names[1] == wanted[mirror]
    assert looks_like_joint_clip(path)


@pytest.mark.parametrize("form", ["own.csv", "unitree.csv", "own.npz"])
def test_round_trip(tmp_path, form):
    clip = JointClip("a", 30.0, *arrays(3), ("a_joint", "b_joint", "c_joint"))
    path = tmp_path / form
    if form == "own.npz":
        save_robot_npz(path, clip)
    else:
        save_robot_csv(path, clip, header=form == "own.csv")
    back = read_joint_clip(path)
    check(back, arrays(3), 30.0)
    assert back.joint_names == (None if form == "unitree.csv" else clip.joint_names)
    assert looks_like_joint_clip(path)


def test_wxyz_is_reported_and_swapped(tmp_path, caplog):
    position, rotation, dofs = arrays(12)
    table = np.hstack((position, np.roll(rotation, 1, axis=1), dofs))
    path = write_rows(tmp_path / "a.csv", table)
    read_joint_clip(path)
    assert "quat_order='wxyz'" in caplog.text
    caplog.clear()
    check(read_joint_clip(path, quat_order="wxyz"), arrays(12), 30.0)
    assert not caplog.text


def test_wrong_rate_is_reported(tmp_path, caplog):
    read_joint_clip(write_rows(tmp_path / "a.csv", np.hstack(arrays(12))), fps=5000.0)
    assert "m/s at 5000 fps" in caplog.text and "rad/s at 5000 fps" in caplog.text


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("1,2,3\n1,2,3\n", "3 columns and no header"),
        ("0,0,1,0,0,0,1,0\n0,0,1,0,0,0,1\n", "row 2 has 7 values"),
        ("0,0,1,0,0,0,1,nan\n0,0,1,0,0,0,1,0\n", "NaN"),
        ("0,0,1,0,0,0,2,0\n0,0,1,0,0,0,1,0\n", "no unit quaternion"),
        ("", "holds 0 line"),
    ],
)
def test_broken_tables(tmp_path, content, match):
    path = tmp_path / "a.csv"
    path.write_text(content)
    with pytest.raises(MotionFileError, match=match):
        read_joint_clip(path)


def test_archive_of_objects_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    position, rotation, dofs = arrays(3)
    np.savez(path, fps=30, root_pos=position, root_rot=rotation, dof_pos=dofs.astype(object))
    with pytest.raises(MotionFileError, match="holds objects"):
        read_joint_clip(path)
