"""Gains of drives: the user's, the file's, and those that follow from efforts or the weight."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.robots.load import prepare_robot
from tests.robots.texts import LEG, mjcf


def drives(text: str):
    return prepare_robot(mujoco.MjSpec.from_string(text)).drives


def actuators(text: str) -> str:
    return f"<actuator>{text}</actuator>"


def test_position_actuators_of_the_file_give_the_gains():
    one = '<position joint="hip" kp="30" kv="4" gear="2" forcerange="-5 5"/>'
    hip, _knee = drives(mjcf(rest=actuators(one)))
    assert (hip.kp, hip.kd, hip.effort) == (120, 16, 10)  # gear counts twice for gains


def test_motors_give_the_effort():
    one = '<motor joint="hip" gear="40" ctrlrange="-0.5 0.5"/>'
    hip, _knee = drives(mjcf(rest=actuators(one)))
    assert hip.effort == 20
    assert hip.kp == pytest.approx(60)
    assert hip.kd == pytest.approx(6)


def test_limits_of_joints_give_the_effort():
    leg = LEG.replace('name="knee"', 'name="knee" actuatorfrcrange="-9 9"')
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=leg)))
    assert robot.drives[1].effort == 9
    assert not robot.model.jnt_actfrclimited.any()  # the drive's own limit counts


def test_without_efforts_the_weight_counts():
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf()))
    weight = robot.model.body_subtreemass[0] * 9.81
    hip = robot.drives[0]
    assert hip.effort == pytest.approx(0.35 * weight * robot.start_height)
    assert hip.kp == pytest.approx(3 * hip.effort)


def test_efforts_beyond_reason_do_not_make_gains_beyond_reason():
    leg = LEG.replace('name="knee"', 'name="knee" actuatorfrcrange="-1e5 1e5"')
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=leg)))
    assert robot.drives[1].effort == 1e5
    assert robot.drives[1].kp < 1000


def test_ball_joints_have_three_drives_in_the_order_of_the_degrees_of_freedom():
    leg = LEG.replace('name="hip" axis="0 1 0" range="-1 1"', 'name="hip" type="ball" range="0 2"')
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=leg)))
    names = tuple(robot.model.actuator(i).name for i in range(robot.model.nu))
    assert names == robot.layout.dof_names == ("hip_x", "hip_y", "hip_z", "knee")
    assert robot.model.actuator_gear[:3, :3].tolist() == np.eye(3).tolist()
    assert robot.model.actuator_lengthrange[:3].tolist() == [[-2, 2]] * 3
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.start_qpos
    data.qpos[7:11] = (np.cos(0.2), 0, np.sin(0.2), 0)
    mujoco.mj_forward(robot.model, data)
    np.testing.assert_allclose(data.actuator_length[:3], [0, 0.4, 0], atol=1e-12)


def test_defaults_of_the_file_do_not_reach_the_drives():
    default = """<default><general ctrllimited="true" ctrlrange="0 0.1" dyntype="filter"
      dynprm="9" gainprm="7" biasprm="1 2 3"/><joint damping="5" armature="3"/></default>"""
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf(rest=default)))
    model = robot.model
    assert not model.actuator_ctrllimited.any()
    assert model.na == 0
    assert model.actuator_biasprm[0, 0] == 0
    assert model.dof_armature[:6].tolist() == [0] * 6
    assert model.dof_armature[6] == 3
