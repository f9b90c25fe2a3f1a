"""Legs that are bent for the start, of robots whose files have no keyframe."""

from __future__ import annotations

import mujoco
import numpy as np

from isaacgymenvs_lite.robots.load import PreparedRobot, prepare_robot
from isaacgymenvs_lite.robots.settings import RobotSettings

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
