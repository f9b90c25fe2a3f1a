"""The G1 and the quadruped that ship: public numbers, and that they stand."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot
from isaacgymenvs_lite.robots.settings import RobotSettings

# The order of columns in Unitree's LAFAN1 files for the G1.
LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = (*("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),)
ARM = (*ARM, "wrist_roll", "wrist_pitch", "wrist_yaw")
JOINTS = (
    *(f"{side}_{name}_joint" for side in ("left", "right") for name in LEG),
    *(f"waist_{axis}_joint" for axis in ("yaw", "roll", "pitch")),
    *(f"{side}_{name}_joint" for side in ("left", "right") for name in ARM),
)


@cache
def shipped(name: str) -> PreparedRobot:
    return load_robot(assets_dir() / "mjcf" / f"{name}.xml")


def test_joints_of_the_g1():
    robot = shipped("g1")
    assert robot.layout.dof_names == JOINTS
    assert robot.key_bodies == (
        *("left_ankle_roll_link", "right_ankle_roll_link"),
        *("left_wrist_yaw_link", "right_wrist_yaw_link"),
    )
    assert robot.contact_bodies == robot.key_bodies[:2]


def test_numbers_of_the_g1():
    model = shipped("g1").model
    # Sum of the masses of g1_29dof_rev_1_0; Unitree says "about 35 kg" with the battery.
    assert model.body_subtreemass[0] == pytest.approx(33.341, abs=1e-3)
    ranges = {name: model.joint(name).range.tolist() for name in JOINTS}
    assert ranges["left_knee_joint"] == [-0.087267, 2.8798]
    assert ranges["left_hip_roll_joint"] == [-0.5236, 2.9671]
    assert ranges["right_hip_roll_joint"] == [-2.9671, 0.5236]
    efforts = {drive.joint: drive.effort for drive in shipped("g1").drives}
    assert [efforts[f"left_{name}_joint"] for name in LEG] == [88, 139, 88, 139, 50, 50]
    assert [efforts[f"right_{name}_joint"] for name in ARM] == [25, 25, 25, 25, 25, 5, 5]


def test_numbers_of_the_quadruped():
    robot = shipped("quadruped")
    legs = ("FL", "FR", "RL", "RR")
    joints = tuple(f"{leg}_{part}_joint" for leg in legs for part in ("hip", "thigh", "calf"))
    assert robot.layout.dof_names == joints
    assert robot.model.body_subtreemass[0] == pytest.approx(6.921 + 4 * (0.678 + 1.152 + 0.241352))
    assert robot.key_bodies == robot.contact_bodies == tuple(f"{leg}_foot" for leg in legs)
    assert [drive.effort for drive in robot.drives[:3]] == [23.7, 23.7, 45.43]


@pytest.mark.parametrize("name", ["g1", "quadruped"])
def test_the_keyframe_is_within_limits_and_on_the_floor(name):
    robot = shipped(name)
    low, high = robot.model.jnt_range[1:].T
    assert ((low <= robot.start_qpos[7:]) & (robot.start_qpos[7:] <= high)).all()
    file = mujoco.MjModel.from_xml_path(str(assets_dir() / "mjcf" / f"{name}.xml"))
    assert file.key("home").qpos[2] == pytest.approx(robot.start_height, abs=2e-3)
    assert (file.nu, file.nsensor) == (len(robot.drives), 0)


# The G1's own ankles, 40 Nm/rad each, are too soft to hold it without a controller.
STIFF = {
    "*_hip_roll_*": 417,
    "*_hip_*": 264,
    "*_knee_*": 417,
    "*_ankle_*": 150,
    "waist_yaw_*": 264,
    "waist_*": 150,
    "*_wrist_roll_*": 75,
    "*_wrist_*": 15,
    "*": 75,
}


@pytest.mark.parametrize("name", ["g1", "quadruped"])
def test_it_stands_for_two_seconds(name):
    robot = shipped(name)
    if name == "g1":
        drives = {pattern: {"kp": kp, "kd": 0.1 * kp} for pattern, kp in STIFF.items()}
        robot = load_robot(assets_dir() / "mjcf/g1.xml", RobotSettings(drives=drives))
    model, data = robot.model, mujoco.MjData(robot.model)
    model.opt.timestep = 0.005
    data.qpos[:] = robot.start_qpos
    data.ctrl[:] = robot.start_qpos[7:]
    mujoco.mj_step(model, data, 400)
    assert abs(data.qpos[2] - robot.start_height) < 0.03
    assert np.abs(data.qpos[:2]).max() < 0.03
    upright = 1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2)  # z of the base's z axis
    assert upright > 0.99
    assert np.abs(data.qpos[7:] - robot.start_qpos[7:]).max() < 0.1
    assert np.abs(data.qvel).max() < 0.1
    # MuJoCo's sensor has the force of the body on the floor.
    weight = robot.model.body_subtreemass[0] * 9.81
    columns = robot.layout.contact_columns
    assert columns is not None
    feet = [robot.layout.body_names.index(foot) for foot in robot.contact_bodies]
    forces = data.sensordata[columns[feet]].sum(axis=0)
    assert -forces[2] == pytest.approx(weight, rel=0.05)
