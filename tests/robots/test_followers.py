"""Joints that follow others; MuJoCo's own residuals of its constraints are the reference."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.robots.load import prepare_robot
from isaacgymenvs_lite.robots.settings import RobotSettings

CHAIN = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><freejoint/>
<geom size=".1"/><body name="a"><joint name="a" axis="0 1 0" ref="0.3"/><geom size=".1"/>
<body name="b" pos="0 0 -.3"><joint name="b" axis="0 1 0" ref="-0.2"/><geom size=".1"/>
<body name="c" pos="0 0 -.3"><joint name="c" axis="1 0 0"/><geom size=".1"/>
<body name="d" pos="0 0 -.3"><joint name="d" axis="1 0 0"/><geom name="tip" size=".1"/>
<site name="end"/></body></body></body></body></body></worldbody>
<equality>{}</equality></mujoco>"""
FOLLOWING = """<joint joint1="c" joint2="b" polycoef=".1 -2 0 0 .3"/>
<joint joint1="b" joint2="a" polycoef="-.1 .5 .2 .4 0"/><joint joint1="d" polycoef=".25 0 0 0 0"/>
"""


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CHAIN.format(FOLLOWING))


def test_placed_followers_meet_mujocos_constraints(model):
    qpos = np.tile(model.qpos0, (5, 1))
    qpos[:, 7] = np.linspace(-1, 1, 5)
    followers = Followers(model)
    data = mujoco.MjData(model)
    for pose in followers.placed(qpos):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        equalities = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert equalities.sum() == 3
        np.testing.assert_allclose(data.efc_pos[equalities], 0.0, atol=1e-12)
    assert set(followers.names) == {"b", "c", "d"}


def test_leaders_move_their_followers_in_jacobians(model):
    followers, data, tip = Followers(model), mujoco.MjData(model), model.geom("tip").id
    body, jacobian = model.body("d").id, np.zeros((3, model.nv))

    def place(angle: float) -> np.ndarray:
        data.qpos[:] = model.qpos0
        data.qpos[7] = angle
        data.qpos[:] = followers.placed(data.qpos)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return data.geom_xpos[tip].copy()

    by_differences = (place(0.6 + 1e-6) - place(0.6 - 1e-6)) / 2e-6
    mujoco.mj_jac(model, data, jacobian, None, place(0.6), body)
    led = followers.led(jacobian, data.qpos)
    np.testing.assert_allclose(led[:, 6], by_differences, atol=1e-8)
    assert not led[:, 7:].any()


@pytest.mark.parametrize(
    ("equality", "named"),
    [
        ('<joint joint1="a" joint2="b"/><joint joint1="b" joint2="a"/>', "joints a, b follow each"),
        ('<joint joint1="a" joint2="b"/><joint joint1="a" joint2="c"/>', "joint 'a' has two"),
        (
            '<connect name="rod" site1="end" site2="hip"/>',
            "the <connect> 'rod' in <equality> joins 'd' and 'base'",
        ),
        ('<weld body1="d" body2="a"/>', "the <weld> in <equality> joins 'd' and 'a'"),
    ],
)
def test_what_kinematics_cannot_follow_is_refused_by_name(equality, named):
    text = CHAIN.format(equality).replace("<freejoint/>", '<freejoint/><site name="hip"/>')
    with pytest.raises(ConfigError, match=named):
        prepare_robot(mujoco.MjSpec.from_string(text))


def test_the_start_pose_follows_and_says_where_it_differs_from_the_users():
    spec = mujoco.MjSpec.from_string(CHAIN.format(FOLLOWING))
    robot = prepare_robot(spec, RobotSettings(start_pose={"a": 0.8, "b": 1.0}))
    b = -0.2 - 0.1 + 0.5 * 0.5 + 0.2 * 0.5**2 + 0.4 * 0.5**3
    c = 0.1 - 2.0 * (b + 0.2) + 0.3 * (b + 0.2) ** 4
    np.testing.assert_allclose(robot.start_qpos[7:], [0.8, b, c, 0.25], atol=1e-12)
    assert f"start pose: 'b' follows at {b:.3f} rad, not 1.000" in robot.notes


def test_a_follower_of_a_fixed_slide_is_held():
    text = CHAIN.format('<joint joint1="b" joint2="a" polycoef=".4 2 0 0 0"/>')
    text = text.replace('name="a" axis="0 1 0" ref="0.3"', 'name="a" type="slide"')
    robot = prepare_robot(mujoco.MjSpec.from_string(text))
    assert robot.start_qpos[robot.model.joint("b").qposadr[0]] == pytest.approx(-0.2 + 0.4)
