"""Gains of drives: the user's, the file's, and those that follow from efforts or the weight."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot, prepare_robot
from isaacgymenvs_lite.robots.settings import RobotSettings
from isaacgymenvs_lite.schema import read_section
from tests.robots.texts import LEG, mjcf


def drives(text: str):
    return prepare_robot(mujoco.MjSpec.from_string(text)).drives


def actuators(text: str) -> str:
    return f"<actuator>{text}</actuator>"


def test_position_actuators_of_the_file_give_the_gains():
    one = '<position joint="hip" kp="30" kv="4" gear="2" forcerange="-5 5"/>'
    hip, _knee = drives(mjcf(rest=actuators(one)))
    assert (hip.kp, hip.kd, hip.effort) == (120, 16, 10)  # gear counts twice for gains


def prepared(effort: float) -> PreparedRobot:
    leg = LEG.replace('name="knee"', f'name="knee" actuatorfrcrange="-{effort} {effort}"')
    return prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=leg)))


def weight_moment(robot: PreparedRobot) -> float:
    return float(robot.model.body_subtreemass[0]) * 9.81 * robot.start_height


def test_motors_give_the_effort():
    one = '<motor joint="hip" gear="4" ctrlrange="-0.5 0.5"/>'
    hip, _knee = drives(mjcf(rest=actuators(one)))
    assert (hip.effort, hip.kp) == (2, 8)
    assert hip.kd == pytest.approx(0.24)


def test_without_efforts_the_weight_counts():
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf()))
    hip = robot.drives[0]
    assert hip.effort == pytest.approx(0.35 * weight_moment(robot))
    assert hip.kp == pytest.approx(4 * hip.effort)


def test_an_ankle_carries_the_robot_and_a_finger_does_not():
    """Of unknown efforts: a light foot moves the robot over it, a light finger only itself."""
    foot = LEG.replace('size="0.05"', 'size="0.05" mass="1e-3"')
    finger = """<body name="finger" pos="0.1 0 0"><joint name="finger" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.05 0 0" size="0.01" mass="1e-2"/></body>"""
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=foot + finger)))
    by_name = {drive.joint: drive.effort for drive in robot.drives}
    assert by_name["knee"] == by_name["hip"] == pytest.approx(0.35 * weight_moment(robot))
    inertia = robot.model.dof_M0[robot.model.joint("finger").dofadr[0]]
    inertia -= robot.model.dof_armature[robot.model.joint("finger").dofadr[0]]
    assert by_name["finger"] == pytest.approx(5000 * inertia, rel=1e-6)
    assert by_name["finger"] < 0.02 * by_name["knee"]


def test_efforts_beyond_reason_do_not_make_gains_beyond_reason():
    robot = prepared(effort=1e5)
    assert robot.drives[1].effort == 1e5  # the joint's limit
    assert not robot.model.jnt_actfrclimited.any()  # the drive's own limit counts
    assert robot.drives[1].kp == pytest.approx(4 * 0.6 * weight_moment(robot))


def test_an_action_of_one_is_worth_four_efforts():
    for gains, wanted in (
        ({}, 1.0),  # the project's own: four times an effort in Nm for an error of 1 rad
        ({"*": {"kp": 20.0, "effort": 4.0}}, 0.8),
        ({"*": {"kp": 0.5, "effort": 2.0}}, 2.0),  # the most
    ):
        settings = read_section(RobotSettings, {"drives": gains}, "robot")
        robot = prepare_robot(mujoco.MjSpec.from_string(mjcf()), settings)
        assert robot.action_range_rad == pytest.approx(wanted)


def test_an_action_of_weak_motors_is_worth_a_share_of_the_weight():
    """As in dm_control's humanoid, 40 Nm for 515 Nm."""
    settings = read_section(RobotSettings, {"drives": {"*": {"kp": 10.0, "effort": 1.0}}}, "robot")
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf()), settings)
    assert robot.action_range_rad == pytest.approx(0.6 * weight_moment(robot) / 10)


def test_the_shipped_robots_keep_their_actions():
    assert load_robot(assets_dir() / "mjcf/g1.xml").action_range_rad == 2.0
    quadruped = load_robot(assets_dir() / "mjcf/quadruped.xml")
    assert quadruped.action_range_rad == pytest.approx(4 * 23.7 / 100)


def test_drives_are_stable_whatever_they_carry():
    """Any targets in steps of 8.3 ms: a toe of 1 g with a motor of 5 Nm, no rotors in the file."""
    toe = """<body name="toe" pos="0 0 -0.1"><joint name="toe" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.02" size="0.003" mass="1e-3"/></body>"""
    leg = LEG.replace("</body></body>", f"</body>{toe}</body>")
    one = '<motor joint="toe" ctrlrange="-5 5"/>'
    robot = prepare_robot(mujoco.MjSpec.from_string(mjcf(leg=leg, rest=actuators(one))))
    assert robot.drives[2].armature == pytest.approx(1.5e-4 * 5)
    model, data = robot.model, mujoco.MjData(robot.model)
    model.opt.timestep = 0.0083
    data.qpos[:] = robot.start_qpos
    rng = np.random.default_rng(0)
    fastest = 0.0
    for _ in range(100):
        data.ctrl[:] = robot.start_qpos[7:] + rng.uniform(-1, 1, 3) * robot.action_range_rad
        mujoco.mj_step(model, data, 4)
        fastest = max(fastest, float(np.abs(data.qvel).max()))
    assert fastest < 100
    assert not any(warning.number for warning in data.warning)


def test_rotors_and_gains_of_the_file_stay():
    for joint, gains in (
        ('armature="0.2"', ""),
        ("", '<position joint="hip" kp="30" forcerange="-5 5"/>'),
    ):
        leg = LEG.replace('<joint name="hip"', f'<joint name="hip" {joint}')
        hip, _knee = drives(mjcf(leg=leg, rest=actuators(gains)))
        assert hip.armature == (0.2 if joint else 0.0)


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
