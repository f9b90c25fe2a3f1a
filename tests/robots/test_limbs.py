"""Ends of limbs and what touches the floor."""

from __future__ import annotations

import mujoco

from isaacgymenvs_lite.robots.load import prepare_robot
from tests.robots.texts import mjcf

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
