"""Legs that are bent for the start, of robots whose files have no keyframe."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot, prepare_robot
from isaacgymenvs_lite.robots.settings import RobotSettings
from isaacgymenvs_lite.robots.start_pose import CLEARANCE, start_height
from tests.robots.texts import TETRAHEDRON, mjcf, written

# Thigh and shank of 0.2 m with a ball of 0.02 m; the limits and directions of its joints vary.
LEG = """<body name="{name}_hip" pos="{x} {y} 0"><joint name="{name}_roll" axis="1 0 0"/>
  <geom size="0.01" contype="0" conaffinity="0"/>
  <body name="{name}_thigh" euler="0 {pitch} 0">
  <joint name="{name}_hip" axis="0 {sign} 0" range="{hip}"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02"/>
  <body name="{name}_shank" pos="0 0 -0.2"><joint name="{name}_knee" axis="0 1 0" range="{knee}"/>
  <geom type="capsule" fromto="0 0 -.05 0 0 -0.15" size="0.01"/>
  <body name="{name}" pos="0 0 -0.2"><geom size="0.02"/></body></body></body></body>
"""
CORNERS = {"fl": (0.3, 0.1), "fr": (0.3, -0.1), "rl": (-0.3, 0.1), "rr": (-0.3, -0.1)}


def robot(
    hip: str = "-3 3",
    knee: str = "-3 3",
    sign: int = 1,
    legs: int = 4,
    pitch: float = 0.0,
    rest: str = "",
    settings: RobotSettings | None = None,
) -> PreparedRobot:
    limbs = "".join(
        LEG.format(name=name, x=x, y=y, hip=hip, knee=knee, sign=sign, pitch=pitch)
        for name, (x, y) in list(CORNERS.items())[:legs]
    )
    text = f"""<mujoco><compiler angle="radian"/><worldbody><body name="trunk">
      <geom type="box" size=".2 .05 .03"/>{limbs}</body></worldbody>{rest}</mujoco>"""
    return prepare_robot(mujoco.MjSpec.from_string(text), settings)


def places(prepared: PreparedRobot, part: str) -> np.ndarray:
    data = mujoco.MjData(prepared.model)
    data.qpos[:] = prepared.start_qpos
    mujoco.mj_kinematics(prepared.model, data)
    return np.array([data.body(f"{name}{part}").xpos for name in CORNERS])


def test_feet_are_below_the_hips_and_knees_behind():
    for sign, knee in ((1, "-3 3"), (-1, "-3 3"), (1, "-2.7 -0.9")):
        prepared = robot(sign=sign, knee=knee)
        feet, hips = places(prepared, ""), places(prepared, "_hip")
        np.testing.assert_allclose(hips - feet, np.tile((0, 0, 0.75 * 0.4), (4, 1)), atol=1e-9)
        assert (places(prepared, "_shank")[:, 0] < hips[:, 0] - 0.1).all()
        assert prepared.contact_bodies == tuple(CORNERS)
        assert any("legs bent" in note for note in prepared.notes)


def test_knees_bend_as_their_limits_say():
    prepared = robot(knee="0.5 2.5")
    assert (places(prepared, "_shank")[:, 0] > places(prepared, "_hip")[:, 0] + 0.1).all()


def test_a_robot_whose_zero_angles_lift_its_legs_stands_up():
    """Of the vision60: at zero its legs lie along the trunk, which is on the floor."""
    prepared = robot(pitch=1.7)
    assert prepared.contact_bodies == tuple(CORNERS)
    feet, hips = places(prepared, ""), places(prepared, "_hip")
    np.testing.assert_allclose(hips - feet, np.tile((0, 0, 0.3), (4, 1)), atol=1e-9)


def test_other_robots_keep_their_angles():
    for prepared in (
        robot(rest="<keyframe><key/></keyframe>"),
        robot(legs=2),
        robot(settings=RobotSettings(start_pose={"fl_roll": 0.0})),
        robot(knee="-0.1 0.1"),  # knees that do not bend
    ):
        np.testing.assert_array_equal(prepared.start_qpos[7:], 0.0)


SHAPES = {
    "sphere": '<geom type="sphere" size="0.2"/>',
    "capsule": '<geom type="capsule" size="0.1 0.2"/>',
    "cylinder": '<geom type="cylinder" size="0.1 0.2"/>',
    "ellipsoid": '<geom type="ellipsoid" size="0.1 0.2 0.4"/>',
    "box": '<geom type="box" size="0.1 0.2 0.4"/>',
    "mesh": '<geom type="mesh" mesh="tet"/>',
}


def test_the_lowest_point_is_a_millimetre_above_the_floor(tmp_path):
    for shape in SHAPES:
        leg = f'<body pos="0 0 -1"><joint axis="0 1 0"/>{SHAPES[shape]}</body>'
        written(tmp_path / "tet.obj", TETRAHEDRON)
        rest = '<asset><mesh name="tet" file="tet.obj"/></asset>'
        robot = load_robot(written(tmp_path / "r.xml", mjcf(leg=leg, rest=rest)))
        data = mujoco.MjData(robot.model)
        rng = np.random.default_rng(0)
        for _ in range(20):
            qpos = np.array([3, 4, 5, *rng.normal(size=4), rng.uniform(-3, 3)])
            qpos[3:7] /= np.linalg.norm(qpos[3:7])
            qpos[2] = start_height(robot.model, qpos)
            data.qpos[:] = qpos
            mujoco.mj_forward(robot.model, data)
            assert data.ncon == 0
            data.qpos[2] -= CLEARANCE + 1e-6
            mujoco.mj_forward(robot.model, data)
            assert data.ncon > 0
            assert min(contact.dist for contact in data.contact) == pytest.approx(-1e-6, abs=1e-8)


def test_keyframes():
    for keys, wanted in (
        ('<key name="a" qpos="0 0 9 1 0 0 0 0.1 1"/>', 0.1),
        ('<key qpos="0 0 9 1 0 0 0 0.1 1"/><key name="home" qpos="0 0 9 1 0 0 0 0.2 1"/>', 0.2),
        ('<key name="stand" qpos="0 0 9 1 0 0 0 0.3 1"/><key name="a"/>', 0.3),
    ):
        text = mjcf(rest=f"<keyframe>{keys}</keyframe>")
        robot = prepare_robot(mujoco.MjSpec.from_string(text))
        assert robot.start_qpos[7] == wanted
        assert robot.start_height < 1


def test_geoms_that_cannot_touch_do_not_count():
    leg = """<body><joint name="a"/><geom size="0.1"/>
    <geom size="0.1" pos="0 0 -3" contype="0" conaffinity="0"/></body>"""
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=leg)))
    assert robot.start_height == pytest.approx(0.1 + CLEARANCE)


BALL = '<geom size="0.02"/>'


def ends(leg: str) -> tuple[str, ...]:
    return prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=leg))).key_bodies


def arm(name: str, y: float, rest: str) -> str:
    return f'<body name="{name}" pos="0 {y} 0"><joint name="{name}"/>{BALL}{rest}</body>'


def test_a_foot_on_a_fixed_joint_is_an_end_and_a_housing_beside_a_joint_is_not():
    foot = f'<body name="foot" pos="0 0 -1">{BALL}</body>'
    housing = f'<body name="housing" pos="0.1 0 0">{BALL}</body>'
    frame = '<body name="frame"/>'
    assert ends(arm("hip", 0.1, housing + arm("knee", 0.3, foot + frame))) == ("foot",)


def test_fixed_parts_of_the_base_are_no_ends():
    head = f'<body name="head" pos="0 0 0.2">{BALL}</body>'
    assert ends(head + arm("hip", 0.1, "")) == ("hip",)


def test_a_limb_below_a_fixed_link_is_found_beside_others():
    """Of the humanoid of CMU's clips: its thighs hang on links that are fixed to the root."""
    fixed = f'<body name="hip_link" pos="0 0.1 0">{BALL}{arm("thigh", 0.1, arm("toe", 0.4, ""))}'
    assert ends(f"{fixed}</body>" + arm("spine", -0.5, "")) == ("toe", "spine")


def test_of_what_is_fixed_to_the_last_link_the_farthest_is_the_end():
    guard = f'<body name="guard" pos="0 0 -0.5">{BALL}</body>'
    foot = f'<body name="foot" pos="0 0 -1">{BALL}</body>'
    assert ends(arm("knee", 0.3, guard + foot + '<body name="sensor" pos="0 0 -2"/>')) == ("foot",)


def test_fingers_count_as_the_hand():
    fingers = "".join(arm(f"finger{i}", 0.02 * (i + 1), "") for i in range(4))
    limbs = arm("left", 0.5, arm("hand", 0.5, fingers)) + arm("right", -0.5, "")
    assert ends(limbs) == ("hand", "right")


def test_bodies_that_touch_the_floor():
    legs = "".join(
        f'<body name="{name}" pos="0 {y} 0"><joint name="{name}"/>'
        f'<geom type="capsule" fromto="0 0 0 0 0 {-length}" size="0.02"/></body>'
        for name, y, length in (("a", 0.1, 0.5), ("b", 0.2, 0.495), ("c", 0.3, 0.4))
    )
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=legs)))
    assert robot.contact_bodies == ("a", "b")
    # Of a robot of 2 m a heel that is 3 cm above the toes.
    tall = legs.replace("-0.495", "-1.97").replace("-0.5", "-2")
    assert prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=tall))).contact_bodies == ("a", "b")
