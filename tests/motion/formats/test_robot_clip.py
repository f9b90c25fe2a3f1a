"""The tests write files by csv text, pickle and numpy instead of the project's writers."""

from __future__ import annotations

import os
import pickle

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import JointClip
from isaacgymenvs_lite.motion.formats.joint_csv import G1_29, G1_29_BREADTH_FIRST, save_robot_csv
from isaacgymenvs_lite.motion.formats.robot_clip import (
    looks_like_joint_clip,
    read_joint_clip,
    read_joint_clips,
    save_robot_npz,
)

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


def test_unitrees_table(tmp_path):
    for num_dofs, number, name in (
        (29, 12, "waist_yaw_joint"),
        (12, 0, None),
    ):
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


def test_gmr(tmp_path):
    for protocol, numpy_1 in ((5, False), (3, True)):
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


def dump(path, data, how):
    """Write a dictionary by pickle, joblib, compressed joblib or numpy."""
    if how == "pickle":
        path.write_bytes(pickle.dumps(data))
    elif how == "numpy":
        np.save(path, data, allow_pickle=True)
    else:
        pytest.importorskip("joblib").dump(data, path, compress=how == "compressed")


@pytest.mark.parametrize(("how", "suffix"), [("joblib", "pkl"), ("compressed", "pickle")])
def test_motions_by_name(tmp_path, how, suffix):
    """Test PHC's form: several motions by name."""
    position, rotation, dofs = arrays(6)
    motion = {"root_trans_offset": position, "root_rot": rotation, "pose_aa": np.zeros((4, 9, 3))}
    motion |= {"dof": np.asfortranarray(dofs)[..., None], "fps": np.int64(50)}
    path = tmp_path / f"a.{suffix}"
    dump(path, {"only/one": motion}, how)
    check(read_joint_clip(path), arrays(6), 50.0)
    assert looks_like_joint_clip(path)
    still = motion | {"root_trans_offset": position.astype(np.float32) * [0.0, 0.0, 1.0]}
    dump(path, {"walk": motion, "b/stand 1": still}, how)
    walk, stand = read_joint_clips(path)
    check(walk, arrays(6), 50.0)
    assert np.all(stand.root_pos[:, 0] == 0.0)
    assert read_joint_clip(f"{path}:b/stand 1").name == f"{path}:b/stand 1"
    with pytest.raises(
        MotionFileError, match=r"2 motions \(walk, b/stand 1\); give one, as .*:walk"
    ):
        read_joint_clip(path)
    with pytest.raises(MotionFileError, match="no motion 'run'; it has walk, b/stand 1"):
        read_joint_clip(f"{path}:run")


def test_names_of_joints_in_a_dictionary(tmp_path):
    for how, suffix, key, as_array in (
        ("pickle", "pkl", "joint_names", True),
        ("numpy", "npy", "dof_names", False),
        ("pickle", "pkl", "", False),
    ):
        position, rotation, dofs = arrays(3)
        names = ["c", "a", "b"]
        data = {"root_pos": position, "root_rot": rotation, "dof_pos": dofs[:, [2, 0, 1]]}
        if key:
            data[key] = np.array(names) if as_array else names
        else:
            data["dof_pos"] = dict(zip(names, data["dof_pos"].T, strict=True))
        path = tmp_path / f"a.{suffix}"
        dump(path, data, how)
        with pytest.raises(MotionFileError, match=r"has no fps; give file_fps="):
            read_joint_clip(path)
        clip = read_joint_clip(path, fps=25.0)
        assert clip.joint_names == tuple(names)
        check(clip.fitted_to(["a", "b", "c"]), arrays(3), 25.0)


def test_code_in_a_pickle_is_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'canary'}",)

    path = write_pickle(tmp_path / "a.pkl", {"fps": 30, "frames": Evil()})
    with pytest.raises(MotionFileError, match="refused, nothing was run"):
        read_joint_clip(path)
    assert not (tmp_path / "canary").exists()


def test_tracking_archive_shows_its_order(tmp_path):
    for mirror, world in ((2, 0), (7, 1)):
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


def test_round_trip(tmp_path):
    for save in (save_robot_csv, save_robot_npz):
        clip = JointClip("a", 30.0, *arrays(3), ("a_joint", "b_joint", "c_joint"))
        path = save(tmp_path / f"a.{save.__name__[-3:]}", clip)
        back = read_joint_clip(path)
        check(back, arrays(3), 30.0)
        assert back.joint_names == clip.joint_names
        assert looks_like_joint_clip(path)


def test_wxyz_is_reported_and_swapped(tmp_path, caplog):
    position, rotation, dofs = arrays(12)
    wxyz = np.roll(rotation, 1, axis=1)
    path = write_rows(tmp_path / "a.csv", np.hstack((position, wxyz, dofs)))
    read_joint_clip(path)
    assert "lies on its side or upside down in 100% of the frames" in caplog.text
    assert "not if the quaternions of the file are wxyz" in caplog.text
    assert "quat_order=wxyz" in caplog.text
    caplog.clear()
    check(read_joint_clip(path, quat_order="wxyz"), arrays(12), 30.0)
    check(read_joint_clip(path, quat_order="wxyz").reread("xyzw"), (position, wxyz, dofs), 30.0)
    assert not caplog.text


def bodies_of_a_walk(frames=8):
    """A root that sways while it walks to the side, a body fixed to it, and a moving body."""
    angle = np.linspace(0.0, 0.2, frames)
    # about z by 90 degrees, then about the root's own x by `angle`
    rotation = np.sqrt(0.5) * np.stack(
        (np.sin(angle / 2), np.sin(angle / 2), np.cos(angle / 2), np.cos(angle / 2)), axis=-1
    )
    root = np.stack((0.0 * angle, angle, 0.0 * angle + 0.8), axis=-1)
    # 0.1 m to the left of the root and 0.1 m below it, by hand
    left = np.stack((-np.cos(angle) - np.sin(angle), 0.0 * angle), axis=-1)
    height = np.sin(angle) - np.cos(angle)
    hip = root + 0.1 * np.concatenate((left, height[:, None]), axis=-1)
    moved = hip + np.linspace([0.0, 0.0, 0.0], [0.0, 0.1, 0.0], frames)
    return root, rotation, np.stack((root, hip, moved), axis=1)


@pytest.mark.parametrize(("order", "world"), [("wxyz", 1), ("xyzw", 0)])
def test_bodies_show_the_order_of_their_quaternions(tmp_path, order, world, caplog):
    root, rotation, bodies = bodies_of_a_walk()
    quaternions = np.repeat(rotation[:, None], 3, axis=1)
    still = [0.0, 0.0, 0.0, 1.0]
    if world:
        bodies = np.insert(bodies, 0, 0.0, axis=1)
        quaternions = np.insert(quaternions, 0, still, axis=1)
    if order == "wxyz":
        quaternions = np.roll(quaternions, 1, axis=-1)
    path = tmp_path / "a.npz"
    dofs = np.zeros((len(root), 2))
    np.savez(path, fps=[50], joint_pos=dofs, body_pos_w=bodies, body_quat_w=quaternions)
    check(read_joint_clip(path), (root, rotation, dofs), 50.0)
    assert not caplog.text
    # what the user says counts
    other = read_joint_clip(path, quat_order="xyzw" if order == "wxyz" else "wxyz")
    assert np.abs(other.root_rot - rotation).max() > 0.5


def test_an_order_of_quaternions_for_a_file_without_them(tmp_path):
    frames = np.zeros((3, 7)).tolist()
    path = write_pickle(tmp_path / "a.pkl", {"fps": 30, "frames": frames})
    with pytest.raises(MotionFileError, match=r"no quaternions, which quat_order=wxyz"):
        read_joint_clip(path, quat_order="wxyz")


def test_wrong_rate_is_reported(tmp_path, caplog):
    read_joint_clip(write_rows(tmp_path / "a.csv", np.hstack(arrays(12))), fps=5000.0)
    assert "m/s at 5000 fps" in caplog.text and "rad/s at 5000 fps" in caplog.text


BOTH_ORDERS = {
    # the indices of a public converter of whole_body_tracking's files, joint by joint of MuJoCo's
    "left leg": (0, 3, 6, 9, 13, 17),
    "right leg": (1, 4, 7, 10, 14, 18),
    "waist": (2, 5, 8),
    "left arm": (11, 15, 19, 21, 23, 25, 27),
    "right arm": (12, 16, 20, 22, 24, 26, 28),
}


def test_the_order_of_isaac_lab():
    places = [place for limb in BOTH_ORDERS.values() for place in limb]
    assert [G1_29_BREADTH_FIRST.index(name) for name in G1_29] == places


def parts(**changed):
    position, rotation, dofs = arrays(3)
    return {"fps": 30, "root_pos": position, "root_rot": rotation, "dof_pos": dofs} | changed


def test_broken_files_are_one_line(tmp_path):
    quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (4, 2, 1))
    tracking = {"fps": [50], "joint_pos": arrays(3)[2], "body_quat_w": quaternions}
    for i, (suffix, content, match) in enumerate(
        (
            ("csv", "1,2,3\n1,2,3\n", "3 columns and no header"),
            ("csv", "1;2;3\n1;2;3\n", "has one column, .* begins with '1;2;3'"),
            ("csv", "0,0,1,0,0,0,1,0\n0,0,1,0,0,0,1\n", "row 2 has 7 values"),
            ("csv", "0,0,1,0,0,0,2,0\n0,0,1,0,0,0,1,0\n", "no unit quaternion"),
            ("npz", parts(dof_pos=np.array([{}])), "Object arrays cannot be loaded"),
            ("npz", parts(dof_pos=np.array(["a"] * 4)), "dof_pos holds <U1, expected numbers"),
            ("npz", parts(joint_names=["a"] * 3), r"has 3 names of joints \(1 different"),
            ("npz", parts(version=7), "a clip of format version 7"),
            ("npz", {"fps": 30}, "holds fps, expected the keys"),
            ("npz", tracking | {"body_pos_w": np.zeros((4, 3))}, r"have shapes \(4, 3\)"),
            ("pkl", {"fps": 30, "frames": [[0.0] * 8, [0.0] * 9]}, "inhomogeneous"),
            ("pkl", {"fps": {}, "frames": [[0.0] * 8] * 2}, "fps holds object, expected numbers"),
            ("pkl", [1, 2], "holds list, expected the keys"),
        )
    ):
        path = tmp_path / f"{i}.{suffix}"
        if suffix == "csv":
            path.write_text(content)
        elif suffix == "npz" and isinstance(content, dict):
            np.savez(path, allow_pickle=True, **content)
        else:
            write_pickle(path, content)
        with pytest.raises(MotionFileError, match=match) as raised:
            read_joint_clip(path)
        assert "\n" not in str(raised.value)
