"""Tests the clip commands with robot=FILE: retargeting, formats and pictures."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion import convert as command
from isaacgymenvs_lite.motion import plot, strip, view
from isaacgymenvs_lite.motion import robot as robot_command
from isaacgymenvs_lite.motion.clip import JointClip
from isaacgymenvs_lite.motion.formats.deepmimic import MOVED_BODIES, save_deepmimic
from isaacgymenvs_lite.motion.formats.robot_clip import read_joint_clip, save_robot_npz
from isaacgymenvs_lite.motion.loader import load_clips, load_single_clip
from isaacgymenvs_lite.motion.robot_file import load_clip_robot
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs
from isaacgymenvs_lite.robots.settings import RobotSettings
from tests.packages import needs

G1 = "robot=mjcf/g1.xml"
AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
URDF_LEG = """
<joint name="{side}_hip" type="revolute"><parent link="base"/><child link="{side}_thigh"/>
<origin xyz="0 {y} 0"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="80" velocity="9"/>
</joint><link name="{side}_thigh">{body}</link>
<joint name="{side}_knee" type="revolute"><parent link="{side}_thigh"/><child link="{side}_shin"/>
<origin xyz="0 0 -.4"/><axis xyz="0 1 0"/><limit lower="0" upper="2.5" effort="80" velocity="9"/>
</joint><link name="{side}_shin">{body}</link>
<joint name="{side}_ankle" type="revolute"><parent link="{side}_shin"/><child link="{side}_foot"/>
<origin xyz="0 0 -.4"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="40" velocity="9"/>
</joint><link name="{side}_foot">{foot}</link>
"""
INERTIA = '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
BODY = f'<inertial><mass value="2"/>{INERTIA}'
FOOT = f"""{BODY}<collision><origin xyz=".05 0 -.03"/>
<geometry><box size=".2 .08 .04"/></geometry></collision>"""

pytestmark = pytest.mark.usefixtures("in_an_empty_folder")


def convert(*words: str) -> None:
    assert command.main(list(words)) == 0


def write_biped(lies: bool = False) -> Path:
    """Write a walker without trunk and arms as URDF; its base has no joint to the world.

    If it lies, its links have y up and z to the right.
    """
    legs = "".join(
        URDF_LEG.format(side=side, y=y, body=BODY, foot=FOOT)
        for side, y in (("left", 0.1), ("right", -0.1))
    )
    path = Path("biped.urdf")
    base = "base"
    if lies:
        base = "root"
        legs += """<joint name="turned" type="fixed"><parent link="root"/><child link="base"/>
        <origin rpy="-1.5707963 0 0"/></joint>"""
        legs += f'<link name="base">{BODY}</link>'
    path.write_text(f'<robot name="biped"><link name="{base}">{BODY}</link>{legs}</robot>')
    return path


@pytest.fixture(scope="module")
def g1() -> Skeleton:
    return load_clip_robot("mjcf/g1.xml").skeleton


@pytest.fixture
def g1_joints() -> JointClip:
    """Half a second of the walk that ships with the G1, 60 fps."""
    whole = read_joint_clip(paths.assets_dir() / "amp" / "robot_motions" / "g1_walk.npz")
    parts = {name: getattr(whole, name)[:31] for name in ("root_pos", "root_rot", "dof_pos")}
    return JointClip("walk", whole.fps, **parts, joint_names=whole.joint_names)


@pytest.fixture
def line_of(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return `line_of(main, *words)`, the one line with which a command ends."""

    def run(main: Callable[[list[str]], int], *words: str) -> str:
        with pytest.raises(SystemExit) as stop:
            main(list(words))
        assert stop.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return run


def test_a_clip_of_the_humanoid_moves_a_robot(g1: Skeleton, caplog) -> None:
    pytest.importorskip("mink")
    with caplog.at_level("INFO"):
        convert("walk", "g1.npz", G1, "end_s=0.5", "fps=30")
    assert "has the bodies of mapping=g1" in caplog.text
    assert "scaled by 0.749 (ratio of leg lengths)" in caplog.text
    assert "no joint is ever at its limit" in caplog.text
    assert "g1.npz: 16 frames at 30 Hz, 0.50 s, 29 degrees of freedom" in caplog.text
    clip, _ = load_single_clip("g1.npz", [g1])
    # In MuJoCo, the soles are on the ground and the hips are between them.
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf" / "g1.xml"))
    data, joints = mujoco.MjData(model), read_joint_clip("g1.npz")
    assert joints.joint_names == tuple(model.joint(i).name for i in range(1, model.njnt))
    corners = np.array(list(itertools.product((-1, 1), repeat=3)))
    for frame in range(16):
        data.qpos[:3], data.qpos[3:7] = joints.root_pos[frame], joints.root_rot[frame][[3, 0, 1, 2]]
        data.qpos[7:] = joints.dof_pos[frame]
        mujoco.mj_kinematics(model, data)
        boxes = [(model.geom(f"{s}_foot").size, data.geom(f"{s}_foot")) for s in ("left", "right")]
        lowest = min((g.xpos + corners * s @ g.xmat.reshape(3, 3).T)[:, 2].min() for s, g in boxes)
        assert -1e-4 < lowest < 0.01
        places = clip.global_poses()[0][frame]
        np.testing.assert_allclose(places, data.xpos[1:], atol=1e-5)


def test_a_robots_clip_in_every_form(g1: Skeleton, g1_joints: JointClip) -> None:
    parts = (g1_joints.root_pos, g1_joints.root_rot, g1_joints.dof_pos)
    np.savetxt("lafan1.csv", np.concatenate(parts, axis=1), fmt="%.12g", delimiter=",")
    convert("lafan1.csv", "a.npz", G1, "file_fps=60")
    convert("a.npz", "b.csv", G1)
    convert("b.csv", "c.npz", G1, "start_s=0.1", "end_s=0.4", "fps=30")
    assert read_joint_clip("a.npz").fps == 60.0
    np.testing.assert_allclose(read_joint_clip("b.csv").dof_pos, g1_joints.dof_pos, atol=1e-9)
    last = read_joint_clip("c.npz")
    np.testing.assert_allclose(last.dof_pos, g1_joints.dof_pos[6:25:2], atol=1e-9)
    np.testing.assert_allclose(last.root_pos, g1_joints.root_pos[6:25:2], atol=1e-9)
    assert load_clips("c.npz", g1)[0][0].num_frames == 10


def test_names_of_bodies_decide_which_one_is_the_root(g1: Skeleton, g1_joints: JointClip) -> None:
    """Isaac Lab's humanoids list the torso first."""
    position = 17
    clip, _ = load_single_clip(Path("g1_walk"), [g1])
    places, turns = clip.global_poses()
    order = [i for i in np.random.default_rng(position).permutation(30) if i != 0]
    order.insert(position, 0)
    np.savez(
        "isaac.npz",
        fps=60,
        dof_names=np.array(g1_joints.joint_names),
        dof_positions=np.asarray(clip.dof_pos),
        body_names=np.array(g1.body_names)[order],
        body_positions=places[:, order],
        body_rotations=turns[:, order][..., [3, 0, 1, 2]],
    )
    convert("isaac.npz", "a.npz", G1)
    found = read_joint_clip("a.npz")
    np.testing.assert_allclose(found.root_pos, clip.root_translation, atol=1e-6)
    np.testing.assert_allclose(found.root_rot, clip.local_rotation[:, 0], atol=1e-6)


def test_joints_of_other_names_count_by_order_when_asked(refused, g1_joints: JointClip) -> None:
    parts = {name: getattr(g1_joints, name) for name in ("root_pos", "root_rot", "dof_pos")}
    names = tuple(f"motor{i}" for i in range(29))
    save_robot_npz("motors.npz", JointClip("m", 60.0, **parts, joint_names=names))
    line = refused("motors.npz", "a.npz", G1)
    assert "only the robot has left_hip_pitch, left_hip_roll" in line
    assert "only the file has motor0, motor1" in line
    convert("motors.npz", "a.npz", G1, "by_order=True")
    np.testing.assert_allclose(read_joint_clip("a.npz").dof_pos, g1_joints.dof_pos, atol=1e-6)


def write_coupled_biped() -> Path:
    """Write the walker with ankles that follow the knees: -0.5 knee + 0.1 rad."""
    path = write_biped()
    text = path.read_text()
    for side in ("left", "right"):
        child = f'<child link="{side}_foot"/>'
        mimic = f'<mimic joint="{side}_knee" multiplier="-0.5" offset="0.1"/>'
        text = text.replace(child, child + mimic)
    path.write_text(text)
    return path


def test_coupled_joints_follow_in_retargeting() -> None:
    pytest.importorskip("mink")
    write_coupled_biped()
    convert("walk", "biped.npz", "robot=biped.urdf", "end_s=0.5")
    clip = read_joint_clip("biped.npz")
    knees, ankles = clip.dof_pos[:, [1, 4]], clip.dof_pos[:, [2, 5]]
    np.testing.assert_allclose(ankles, 0.1 - 0.5 * knees, atol=1e-6)
    assert np.ptp(knees, axis=0).min() > 0.3
    feet = [2 + 1, 5 + 1]
    places = load_single_clip("biped.npz", [load_clip_robot("biped.urdf").skeleton])[0]
    assert 0.03 < places.global_poses()[0][:, feet, 2].min() < 0.07


@pytest.mark.parametrize("names", [True, False])
def test_coupled_joints_of_a_file_come_from_their_leaders(names: bool, caplog) -> None:
    write_coupled_biped()
    time = np.linspace(0.0, 1.0, 20)
    knees = 0.4 + 0.3 * np.stack([np.sin(time), np.cos(time)], axis=1)
    hips, root = 0.1 * knees, np.tile((0.0, 0.0, 0.9), (20, 1))
    upright = np.tile((0.0, 0.0, 0.0, 1.0), (20, 1))
    leaders = [f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee")]
    dofs = np.stack([hips[:, 0], knees[:, 0], hips[:, 1], knees[:, 1]], axis=1)
    save_robot_npz("a.npz", JointClip("a", 30.0, root, upright, dofs, tuple(leaders)))
    convert("a.npz", "b.npz", "robot=biped.urdf", *(() if names else ("by_order=True",)))
    clip = read_joint_clip("b.npz")
    np.testing.assert_allclose(clip.dof_pos[:, [2, 5]], 0.1 - 0.5 * knees, atol=1e-6)
    assert "which follows another" not in caplog.text
    wrong = clip.dof_pos.copy()
    wrong[7, 5] += 0.25
    save_robot_npz("c.npz", JointClip("c", 30.0, root, upright, wrong, clip.joint_names))
    convert("c.npz", "d.npz", "robot=biped.urdf")
    assert "joint 'right_ankle'" in caplog.text
    assert "is up to 0.25 rad off" in caplog.text
    assert "left_ankle" not in caplog.text
    np.testing.assert_allclose(read_joint_clip("d.npz").dof_pos, clip.dof_pos, atol=1e-6)


def test_a_robot_that_lies_in_its_file_is_stood_up(refused, caplog) -> None:
    pytest.importorskip("mink")
    write_biped(lies=True)
    line = refused("walk", "a.npz", "robot=biped.urdf")
    assert "does not stand in its start pose: a hip is " in line
    assert "m above its foot, and the legs are 0.80 m long; give start_pose" in line
    names = [f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shin", "foot")]
    bodies = "".join(f"  {name}: {name}\n" for name in ("pelvis", *names))
    text = f"start_rotation: [0.7071068, 0, 0, 0.7071068]\nbodies:\n{bodies}"
    Path("biped.yaml").write_text(text.replace("pelvis: pelvis", "pelvis: root"))
    # A mapping without bodies finds them by their names.
    Path("start.yaml").write_text(text.partition("bodies")[0])
    robot = load_clip_robot("biped.urdf").skeleton
    feet = [robot.body_names.index(f"{side}_foot") for side in ("left", "right")]
    for mapping in ("biped", "start"):
        file = f"{mapping}.npz"
        convert("walk", file, "robot=biped.urdf", f"mapping={mapping}.yaml", "end_s=0.5")
        heights = load_single_clip(file, [robot])[0].global_poses()[0][:, :, 2]
        assert 0.04 < heights[:, feet].min() < 0.06
        assert heights[:, 0].min() > 0.7
    assert "the root lies on its side" in caplog.text
    caplog.clear()
    upright = RobotSettings(start_rotation=(0.7071068, 0.0, 0.0, 0.7071068))
    load_single_clip("start.npz", [load_clip_robot("biped.urdf", upright).skeleton])
    assert not caplog.text


def test_mistakes_are_one_line(refused) -> None:
    Path("robot.xml").write_text(
        '<mujoco><extension><plugin plugin="own.plugin"/></extension><worldbody/></mujoco>'
    )
    for words, message in (
        (("walk", "a.npz", "robot=mjcf/h1.xml"), "robot=mjcf/h1.xml: no such file in "),
        (("walk", "a.npz", "robot=robot.xml"), "engine plugins are not loaded"),
        (("walk", "a.npy", G1), "found '.npy'; choices: .npz, .csv"),
        (("walk", "a.npz", G1, "num_dofs=28"), "num_dofs=28 selects a humanoid and robot="),
        (("walk", "a.npz", G1, "mapping=cmu,lafan1"), "two mappings of a BVH file's skeleton"),
        (("walk", "a.npz", G1, "mapping=g2"), "a shipped mapping: cmu, lafan1, g1"),
        (("g1_walk", "a.npz", G1, "mapping=g1"), "is a clip of this robot, which needs no mapping"),
        (("walk", "a.npz", G1, "by_order=True"), "holds no joint coordinates of a robot"),
        (("walk.bvh", "a.npz", G1, "file_fps=60"), "are not for a .bvh file"),
        (("walk", "a.npz", "robot=mjcf/anymal.xml"), "robot=mjcf/anymal.xml: cannot find "),
        (("g1_walk", "a.npz"), "task=RobotAMP in training, robot=FILE in the clip commands"),
    ):
        assert message in refused(*words)


def test_a_robots_clip_is_shown_on_it(monkeypatch: pytest.MonkeyPatch, g1_joints) -> None:
    shown = []
    save_robot_npz("walk.npz", g1_joints)
    monkeypatch.setattr(view, "draw_tracks", lambda *args, **_: shown.append(args) or [])
    monkeypatch.setattr(view, "save_video", lambda out, *_: out)
    assert view.main(["walk.npz", G1, "out=walk.mp4"]) == 0
    ((model, (poses,), _),) = shown
    assert model.body("left_ankle_roll_link").id > 0
    np.testing.assert_allclose(poses[:, 7:], g1_joints.dof_pos, atol=1e-6)
    np.testing.assert_allclose(poses[:, :3], g1_joints.root_pos, atol=1e-6)


@pytest.mark.usefixtures("gl")
def test_a_strip_of_a_robots_clip() -> None:
    import PIL.Image

    assert strip.main(["g1_walk", "walk.png", G1, "frames=2", "seconds=0.9"]) == 0
    with PIL.Image.open("walk.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape == (320, 400, 3)
    assert (np.abs(pixels[:, :200] - pixels[:, 200:]) > 30).any()


def test_a_plot_of_a_robots_clip(g1: Skeleton, g1_joints: JointClip) -> None:
    assert plot.main(["g1_walk", G1, "out=walk.png"]) == 0
    assert Path("walk.png").read_bytes().startswith(b"\x89PNG")
    save_robot_npz("walk.npz", g1_joints)
    clip, _ = load_single_clip("walk.npz", [g1])
    angles = plot.joint_angles(clip, g1)
    assert tuple(angles) == g1.dof_names
    np.testing.assert_allclose(angles["left_knee_joint"], g1_joints.dof_pos[:, 3], atol=1e-6)
    feet = load_clip_robot("mjcf/g1.xml").prepared.contact_bodies
    contacts = plot.foot_contacts(load_single_clip("g1_walk", [g1])[0], feet)
    assert sorted(contacts) == ["left_ankle_roll_link", "right_ankle_roll_link"]
    assert all(0.3 < foot.mean() < 0.75 for foot in contacts.values())


@pytest.mark.usefixtures("gl")
def test_a_robot_is_checked_without_a_clip(caplog, line_of) -> None:
    import PIL.Image

    path = write_biped()
    path.write_text(path.read_text().replace('effort="80"', 'effort="20000"', 1))
    with caplog.at_level("INFO"):
        assert robot_command.main(["biped.urdf", "out=start.png"]) == 0
    assert "contact bodies: left_foot, right_foot" in caplog.text
    assert "check the efforts (Nm) of the file: left_hip 2e+04; weight times" in caplog.text
    assert max(len(message) for message in caplog.messages if "start.png" not in message) <= 100
    assert "base 'base' got a free joint" in caplog.text
    with PIL.Image.open("start.png") as image:
        assert image.size == (2 * 200, 320)
    assert "robot=h1.xml: no such file in " in line_of(robot_command.main, "h1.xml")


def test_clips_of_others_are_not_shown(line_of) -> None:
    main = plot.main
    line = line_of(main, "g1_walk", "robot=mjcf/anymal.xml", "out=a.png")
    assert "only the robot has LF_HAA, LF_HFE" in line
    assert "only the file has left_hip_pitch, left_hip_roll" in line
    line = line_of(main, "walk", G1, "out=a.png")
    assert "its skeleton lacks left_hip_pitch_link" in line
    assert "isaacgymenvs-lite convert IN OUT.npz robot=FILE" in line
    line = line_of(main, "g1_walk", "out=a.png")
    assert "robot=FILE in the clip commands" in line
    assert not Path("a.png").exists()


@needs("pybullet_data")
def test_deepmimics_clips_are_not_a_robots(g1: Skeleton) -> None:
    with pytest.raises(MotionFileError, match=r"is a DeepMimic clip of the humanoid; retarget it"):
        load_clips("deepmimic:walk", g1)


def test_a_robot_with_the_humanoids_bodies_is_no_humanoid() -> None:
    """dm_control's humanoid has the names of DeepMimic's bodies, and several hinges on some."""
    hinges = "".join(f'<joint name="{{0}}_{axis}" axis="{rows}"/>' for axis, rows in AXES.items())
    bodies = "".join(
        f'<body name="{name}">{hinges.format(name)}<geom size=".1"/></body>'
        for name in MOVED_BODIES
        if name != "pelvis"
    )
    Path("robot.xml").write_text(
        f'<mujoco><worldbody><body name="pelvis"><freejoint/><geom size=".1"/>{bodies}</body>'
        "</worldbody></mujoco>",
        encoding="utf-8",
    )
    robot = Skeleton.from_mjcf("robot.xml")
    assert set(MOVED_BODIES) <= set(robot.body_names)
    humanoid = skeleton_for_num_dofs(28)
    save_deepmimic("walk.txt", load_clips("walk")[0][0])
    clip, of = load_single_clip("walk.txt", [robot, humanoid])
    assert of is humanoid
    assert set(clip.body_names) == set(humanoid.body_names)
