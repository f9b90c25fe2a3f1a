"""What is added to a robot, left out and refused."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot, prepare_robot
from isaacgymenvs_lite.robots.settings import RobotSettings
from isaacgymenvs_lite.schema import read_section
from tests.robots.texts import LEG, mjcf, urdf, written


def prepared(text: str, **settings: object) -> PreparedRobot:
    spec = mujoco.MjSpec.from_string(text)
    return prepare_robot(spec, read_section(RobotSettings, settings, "robot", complete=True))


def refusal(text: str, **settings: object) -> str:
    with pytest.raises(ConfigError) as caught:
        prepared(text, **settings)
    message = str(caught.value)
    assert "\n" not in message
    return message


def joint_types(robot: PreparedRobot) -> list[str]:
    return [mujoco.mjtJoint(int(kind)).name[6:].lower() for kind in robot.model.jnt_type]


def test_a_complete_robot():
    robot = prepared(mjcf())
    assert robot.layout.body_names == ("base", "thigh", "foot")
    assert robot.layout.dof_names == ("hip", "knee")
    assert robot.layout.has_free_root
    assert robot.layout.contact_columns is not None
    assert robot.layout.contact_columns.tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    assert [robot.model.actuator(i).name for i in range(robot.model.nu)] == ["hip", "knee"]
    assert robot.model.geom("floor").type[0] == mujoco.mjtGeom.mjGEOM_PLANE
    assert robot.key_bodies == robot.contact_bodies == ("foot",)
    # The knee's limits exclude zero: it starts at the nearest. The foot's sphere (0.05 m) is 0.1 m
    # below the knee, which is 0.3 m below the base and turned about x by 0.2 rad.
    np.testing.assert_allclose(robot.start_qpos[7:], [0, 0.2])
    assert robot.start_height == pytest.approx(0.3 + 0.1 * np.cos(0.2) + 0.05 + 0.001, abs=1e-9)
    start = "start pose: no keyframe in the file: joints at zero within limits"
    rotors = "rotors' inertia for 2 joints, 0.00074 to 0.00074 kg m^2"
    assert robot.notes == (start, rotors, "added a floor")
    assert any("hip, knee" in line for line in robot.describe())


def test_a_base_without_a_free_joint_gets_one():
    for base, note in (
        ("", "base 'base' got a free joint"),
        (
            '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide"/>'
            '<joint name="tilt" axis="0 1 0"/>',
            "base 'base' got a free joint instead of x, z, tilt",
        ),
    ):
        robot = prepared(mjcf(base=base))
        assert joint_types(robot) == ["free", "hinge", "hinge"]
        assert robot.layout.dof_names == ("hip", "knee")
        assert note in robot.notes


def test_slides_are_fixed_with_what_refers_to_them():
    leg = LEG.replace('<joint name="hip"', '<joint name="leg" type="slide"/><joint name="hip"')
    rest = """<tendon><fixed name="t"><joint joint="leg" coef="1"/><joint joint="hip" coef="1"/>
    </fixed></tendon><actuator><motor joint="leg"/><motor tendon="t"/></actuator>
    <equality><joint joint1="leg"/></equality>
    <keyframe><key name="home" qpos="1 2 3 0 0 0 1 0.7 0.1 0.5"/></keyframe>"""
    robot = prepared(mjcf(leg=leg, rest=rest))
    assert robot.layout.dof_names == ("hip", "knee")
    assert "fixed slides: leg" in robot.notes
    # The keyframe's other values stay; it turns the base by half a turn about z.
    np.testing.assert_allclose(
        robot.start_qpos[[0, 1, 3, 4, 5, 6, 7, 8]], [0, 0, 0, 0, 0, 1, 0.1, 0.5]
    )


def test_scenery_and_objects_are_left_out():
    world = """<geom name="ground" type="plane" size="1 1 1"/><light pos="0 0 3"/>
    <geom name="wall" type="box" size="1 1 1"/><body name="stone"><geom size="1"/></body>
    <body name="ball"><freejoint/><geom size="0.1"/>
    <camera target="stone" mode="targetbody"/></body>"""
    rest = """<contact><exclude body1="ball" body2="base"/>
    <pair geom1="ground" geom2="shin"/></contact>
    <keyframe><key qpos="0 0 0 1 0 0 0 0 0 2 1 0 0 0 0.5 0.6"/></keyframe>"""
    leg = LEG.replace('<geom type="sphere"', '<geom name="shin" type="sphere"')
    robot = prepared(mjcf(world=world, rest=rest, leg=leg))
    assert robot.layout.body_names == ("base", "thigh", "foot")
    assert [robot.model.geom(i).name for i in range(robot.model.ngeom)].count("floor") == 1
    assert robot.model.npair == 1
    assert "left out what does not belong to the robot: stone, ball, wall" in robot.notes
    np.testing.assert_allclose(robot.start_qpos[7:], [0.5, 0.6])


def test_bodies_that_overlap_at_the_start_do_not_touch():
    """Of the laikago: in MuJoCo's hull of the trunk's mesh are the thighs."""
    leg = LEG.replace('size="0.05" pos="0 0 -0.1"', 'size="0.05" pos="0 0 0.2"')
    robot = prepared(mjcf(leg=leg))  # the foot's ball is in the base's box
    assert "no contacts between bodies that overlap at the start: base and foot" in robot.notes
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.start_qpos
    data.qpos[2] += 1
    mujoco.mj_forward(robot.model, data)
    assert data.ncon == 0


def test_a_base_on_the_ground_has_the_drives_of_one_above_it():
    """Of files that begin at `base_footprint`; the mass is at 0.76 of the base's height."""
    lifted = LEG.replace('pos="0 0 -0.1"><joint', 'pos="0 0 0.35"><joint')
    on_ground = prepared(mjcf(leg=lifted).replace('mass="2"', 'mass="2" pos="0 0 0.45"'))
    above = prepared(mjcf())
    assert on_ground.start_height == pytest.approx(above.start_height - 0.45)
    assert on_ground.drives[0].effort == pytest.approx(0.76 * above.drives[0].effort, rel=0.01)


def test_a_robot_that_lies_is_noted():
    leg = LEG.replace('pos="0 0 -0.1"', 'pos="0 0 0.4"')
    (note,) = [note for note in prepared(mjcf(leg=leg)).notes if "startRotation" in note]
    assert note.startswith("stands on base, no end of a limb")
    # On its side, one limb below and one above.
    above = leg
    for name in ("thigh", "foot", "hip", "knee"):
        above = above.replace(f'"{name}"', f'"other_{name}"')
    (note,) = [n for n in prepared(mjcf(leg=LEG + above)).notes if "startRotation" in n]
    assert note == "stands on foot, one end of a limb: startRotation turns it"
    assert not [note for note in prepared(mjcf()).notes if "startRotation" in note]


def test_numbers_that_no_robot_has_are_refused():
    for old, new, message in (
        ('pos="0 0 -0.1"', 'pos="0 0 1e30"', "body 'thigh' has the position 1e+30 m, expected"),
        ('pos="0 0 -0.1"', 'pos="0 0 nan"', "body 'thigh' has the position nan m"),
        ('range="-1 1"', 'range="-1 1" armature="inf"', "joint 'hip' has the armature inf kg m^2"),
        ('size="0.03"', 'size="0.03" mass="1e9"', "body 'thigh' has the mass 1e+09 kg"),
        ('size="0.05"', 'size="1e3" name="toe" mass="1"', "geom 'toe' has the radius 1e+03 m"),
    ):
        assert old in LEG
        assert message in refusal(mjcf(leg=LEG.replace(old, new, 1)))


def test_all_that_can_touch_touches_the_floor():
    leg = LEG.replace("<geom", '<geom contype="0" conaffinity="4"')
    robot = prepared(mjcf(leg=leg))
    floor = robot.model.geom("floor")
    assert int(floor.contype[0]) & 4


def test_unnamed_bodies_and_joints_get_names():
    leg = re.sub(r' name="(thigh|hip)"', "", LEG)
    robot = prepared(mjcf(leg=leg))
    assert robot.layout.body_names == ("base", "body1", "foot")
    assert robot.layout.dof_names == ("joint1", "knee")


def test_urdf_with_fixed_hand_and_mimic(tmp_path):
    rest = """<link name="finger"><inertial><mass value="0.1"/>
      <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="grip" type="continuous"><parent link="hand"/><child link="finger"/>
      <axis xyz="1 0 0"/><mimic joint="shoulder" multiplier="2" offset="0.5"/></joint>
    <gazebo><plugin name="p" filename="libevil.so"/></gazebo>"""
    robot = load_robot(written(tmp_path / "r.urdf", urdf(rest=rest)))
    assert robot.layout.body_names == ("base", "arm", "hand", "finger")
    assert robot.layout.dof_names == ("shoulder", "grip")
    assert "joint 'grip' follows 'shoulder'" in robot.notes
    assert robot.drives[0].effort == 7
    assert robot.drives[0].kp > 0
    assert (robot.drives[1].kp, robot.drives[1].kd) == (0, 0)  # the other one's drive moves it
    assert robot.model.eq_data[0, :2].tolist() == [0.5, 2.0]


TWIN = """<body name="twin"><freejoint/><geom size="0.1"/>
<body name="arm"><joint name="arm"/><geom size="0.1"/></body></body>"""


def test_robots_that_cannot_be_used(tmp_path):
    for text, reason in (
        (mjcf(leg=""), "has no joints"),
        ("<mujoco/>", "has no joints"),
        (mjcf(base='<joint name="pin"/>'), "pin of body 'base' connects the robot to the world"),
        (mjcf(world=TWIN), "has 2 robots: twin, base"),
        (
            mjcf(rest='<equality><connect body1="foot" body2="base" anchor="0 0 0"/></equality>'),
            "loop",
        ),
        (mjcf(rest='<equality><weld body1="foot" body2="base"/></equality>'), "loop"),
        (mjcf().replace("<geom", '<geom contype="0" conaffinity="0"'), "can touch anything"),
        (mjcf(rest="<actuator><motor joint='none'/></actuator>"), "MuJoCo refuses"),
        (mjcf(rest='<keyframe><key qpos="1 2 3 4 5 6 7 8 9 10"/></keyframe>'), "MuJoCo refuses"),
    ):
        path = written(tmp_path / "r.xml", text)
        with pytest.raises(ConfigError) as caught:
            load_robot(path)
        message = str(caught.value)
        assert message.startswith(str(path))
        assert reason in message
        assert "\n" not in message


def test_constraints_to_the_world_are_released():
    rest = (
        '<equality><weld body1="base"/><weld body1="base" body2="foot" active="false"/></equality>'
    )
    robot = prepared(mjcf(rest=rest))
    assert robot.model.neq == 0
    assert "released 'base', which was fixed in the world" in robot.notes


def test_settings_that_match_nothing():
    for settings, reason in (
        ({"keyBodies": ["hand*"]}, "robot.keyBodies: 'hand*' matches no body"),
        ({"contactBodies": ["foo"]}, "did you mean 'foot'"),
        ({"drives": {"hipp": {}}}, "robot.drives: 'hipp' matches no joint (did you mean 'hip'?)"),
        ({"drives": {"hip": {}}}, "no pattern matches the joints knee"),
        ({"drives": {"*": {"kp": -1}}}, "robot.drives.*.kp: got -1"),
        ({"drives": {"*": {"stiffness": 1, "kP": 1}}}, "kP"),
        ({"startPose": "crouch"}, "crouch"),
        ({"startPose": {"elbow": 1}}, "'elbow' matches no hinge"),
        ({"startPose": {"hip": "x"}}, "robot.startPose.hip"),
        ({"startPose": [1]}, "robot.startPose"),
    ):
        assert reason in refusal(mjcf(), **settings)


def test_errors_name_the_key(tmp_path):
    path = written(tmp_path / "s.xml", mjcf())
    with pytest.raises(ConfigError, match=r"^task.env.robot.keyBodies: 'x'"):
        load_robot(path, RobotSettings(key_bodies=("x",)), "task.env.robot")


def test_settings_of_the_user_count():
    robot = prepared(
        mjcf(),
        keyBodies=["f*", "base"],
        contactBodies=["*"],
        startPose={"h*": 0.3, "*": 0.9},
        startHeight=2,
        startRotation=[0, 0, 1, 0],
        drives={"hip": {"kp": 11, "kd": 2, "effort": 3, "armature": 0.5}, "*": {}},
    )
    assert robot.key_bodies == ("foot", "base")
    assert robot.contact_bodies == ("base", "thigh", "foot")
    np.testing.assert_allclose(robot.start_qpos, [0, 0, 2, 0, 0, 0, 1, 0.3, 0.9])
    model = robot.model
    assert model.actuator_gainprm[0, 0] == 11
    assert model.actuator_biasprm[0, :3].tolist() == [0, -11, -2]
    assert model.actuator_forcerange[0].tolist() == [-3, 3]
    assert model.dof_armature[6] == 0.5
