"""RobotAMP: what it takes from a robot's file, where episodes start, what ends them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite import make
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.clip import JointClip
from isaacgymenvs_lite.motion.formats.robot_clip import save_robot_npz
from isaacgymenvs_lite.tasks.amp.robot_amp import RobotAMP

# Two legs with hips that swing and spread, knees, and feet; faces +x; no drives, no floor.
LEG = """
<body name="{side}_thigh" pos="0 {y} -0.1" euler="0 5 0">
  <joint name="{side}_hip_roll" axis="1 0 0" range="-30 30"/>
  <joint name="{side}_hip_pitch" axis="0 1 0" range="-60 60"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".04" mass="2"/>
  <body name="{side}_shin" pos="0 0 -.3"><joint name="{side}_knee" axis="0 1 0" range="0 120"/>
    <geom type="capsule" fromto="0 0 -.05 0 0 -.25" size=".03" mass="1"/>
    <body name="{side}_foot" pos="0 0 -.3"><joint name="{side}_ankle" axis="0 1 0" range="-40 40"/>
      <geom type="box" pos=".03 0 -.02" size=".1 .04 .02" mass=".5"/></body></body></body>
"""
WALKER = """
<mujoco model="walker"><worldbody><body name="trunk" pos="0 0 .8">
<geom type="box" size=".1 .15 .1" mass="8"/>{legs}</body></worldbody></mujoco>
"""
OF_A_LEG = ("hip_roll", "hip_pitch", "knee", "ankle")
JOINTS = [f"{side}_{joint}" for side in ("left", "right") for joint in OF_A_LEG]


@pytest.fixture
def walker(tmp_path) -> Path:
    legs = "".join(LEG.format(side=side, y=y) for side, y in (("left", 0.1), ("right", -0.1)))
    file = tmp_path / "walker.xml"
    file.write_text(WALKER.format(legs=legs))
    return file


@pytest.fixture
def clip(tmp_path) -> Path:
    """A second in which both knees bend by 1 rad/s, the trunk 0.7 m above the ground."""
    time_s = np.linspace(0.0, 1.0, 31)
    dof_pos = np.zeros((31, 8))
    dof_pos[:, [2, 6]] = time_s[:, None]
    root_pos = np.tile((0.0, 0.0, 0.7), (31, 1))
    root_rot = np.tile((0.0, 0.0, 0.0, 1.0), (31, 1))
    file = tmp_path / "bend.npz"
    save_robot_npz(file, JointClip("bend", 30.0, root_pos, root_rot, dof_pos, tuple(JOINTS)))
    return file


@pytest.fixture
def make_walker(walker, clip):
    made = []

    def make_task(num_envs: int = 4, **env: Any) -> RobotAMP:
        settings = {"asset.assetFileName": walker, "motion_file": clip, **env}
        words = [f"task.env.{key}={value}" for key, value in settings.items()]
        task = make(cfg=compose(["task=RobotAMP", f"num_envs={num_envs}", "seed=1", *words]))
        made.append(task)
        return task

    yield make_task
    for task in made:
        task.close()


def test_what_the_file_lacks_is_found_and_logged(make_walker, caplog):
    caplog.set_level(logging.INFO)
    task = make_walker()
    assert (task.num_actions, task.num_obs) == (8, 1 + 6 + 3 + 3 + 8 + 8 + 3 * 2)
    assert task.key_body_names() == task.contact_body_names() == ("left_foot", "right_foot")
    assert f"joints in order: {', '.join(JOINTS)}" in caplog.text
    assert caplog.text.count("added a floor") == 1


def test_a_robot_whose_base_is_a_point_on_the_ground_falls_as_others_do(
    make_walker, walker, tmp_path
):
    """Its base, at the trunk's place, is the parent of the trunk in files of mobile robots."""
    text = walker.read_text().replace("</body></worldbody>", "</body></body></worldbody>")
    file = tmp_path / "footprint.xml"
    file.write_text(text.replace("<worldbody>", '<worldbody><body name="base">'))
    task = make_walker(**{"asset.assetFileName": file, "stateInit": "Default"})
    task.reset()
    root_states = task.simulation.root_states.clone()
    assert float(root_states[0, 2]) < 0.1
    # Two of four robots are put on their backs.
    root_states[:2, 2:7] = torch.tensor([0.12, 0.0, -(0.5**0.5), 0.0, 0.5**0.5])
    zeros = torch.zeros(4, 8)
    task.simulation.write_state(torch.arange(4), root_states, zeros, zeros)
    terminated = [task.step(zeros)[3]["terminate"] for _ in range(3)]
    assert torch.stack(terminated).any(dim=0).tolist() == [True, True, False, False]


def test_episodes_start_at_moments_of_the_clip(make_walker):
    task = make_walker(64)
    task.reset()
    knees = task.simulation.dof_pos[:, [2, 6]]
    assert torch.equal(knees[:, 0], knees[:, 1])
    assert 0.0 <= float(knees.min()) < 0.1 and 0.9 < float(knees.max()) <= 1.0
    others = task.simulation.dof_pos[:, [0, 1, 3, 4, 5, 7]]
    assert float(others.abs().max()) < 1e-6
    # knees bend at 1 rad/s; float32 angles at 30 Hz
    torch.testing.assert_close(
        task.simulation.dof_vel[:, [2, 6]], torch.ones(64, 2), atol=1e-4, rtol=0
    )


def test_actions_move_the_targets_from_the_start_pose(make_walker):
    task = make_walker(actionScale=0.5)
    _, start = task.default_pose()
    scaling = task.action_scaling()
    assert scaling.unit == "rad"
    torch.testing.assert_close(task.compute_controls(torch.zeros(4, 8)), start.expand(4, 8))
    moved = task.compute_controls(torch.ones(4, 8)) - start
    torch.testing.assert_close(moved, torch.full((4, 8), 0.5))
    # Drives that are found answer to 1 rad with four efforts, which an action of 1 is worth.
    scale = make_walker().action_scaling().scale
    torch.testing.assert_close(scale, torch.ones(8))


def test_a_trunk_on_the_floor_is_a_fall_and_thighs_that_touch_are_none(make_walker):
    task = make_walker(2, stateInit="Default")
    task.reset()
    root, dof_pos = (state.repeat(2, 1) for state in task.default_pose())
    root[0, 2], root[0, 3:7] = 0.3, torch.tensor([0.0, 0.70711, 0.0, 0.70711])  # face down
    dof_pos[1, 0], dof_pos[1, 4] = -0.5, 0.5  # legs crossed, in the air
    root[1, 2] = 3.0
    task.simulation.write_state(torch.arange(2), root, dof_pos, torch.zeros(2, 8))
    fell = torch.zeros(2, dtype=torch.bool)
    for _ in range(10):
        _, _, _, infos = task.step(torch.zeros(2, 8))
        fell |= infos["terminate"].bool()
    assert fell.tolist() == [True, False]


@pytest.mark.slow
def test_a_key_that_fits_no_robot(make_walker):
    for env, message in [
        ({"contactBodies": "[hand]"}, r"task.env.contactBodies.*hand"),
        ({"drives": "{x_*: {kp: 1}}"}, r"task.env.drives.*x_\*"),
        (
            {"startPose": "kneel"},
            r"unknown keyframe 'kneel'; choices: none; see task.env.startPose",
        ),
        ({"terminationHeight": "-1"}, r"terminationHeight"),
    ]:
        with pytest.raises(ConfigError, match=message):
            make_walker(**env)


def test_a_clip_of_another_robot_names_both(make_walker):
    with pytest.raises(
        MotionFileError, match=r"only the robot has left_ankle.*only the file has left_hip_yaw"
    ):
        make_walker(motion_file="g1_walk")


# --- goals ----------------------------------------------------------------------------------------
