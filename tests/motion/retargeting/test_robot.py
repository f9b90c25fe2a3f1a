"""Tests retargeting from the humanoid and BVH files to robots: feet, limits, names, mistakes."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.editing import cut
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.retargeting.mapping_choice import recognise_robot
from isaacgymenvs_lite.motion.retargeting.retarget import RobotMotion, retarget_to_robot
from isaacgymenvs_lite.motion.retargeting.robot import Robot, robot_from_model
from isaacgymenvs_lite.motion.retargeting.robot_mapping import (
    guess_robot_mapping,
    load_robot_mapping,
    shipped_robot_mappings,
)
from isaacgymenvs_lite.motion.retargeting.source import find_sole, source_from_clip
from isaacgymenvs_lite.robots.load import load_robot
from tests.packages import file_of_package
from tools.clip_synthesis.checks import sole_corners

VALID = yaml.safe_load(shipped_robot_mappings()["g1"].read_text())
# A walker with ball hips, without arms or ankles, that faces +y; its feet are balls.
WALKER = """
<mujoco><worldbody><body name="base" pos="0 0 1"><freejoint/><geom size=".1" mass="5"/>
{legs}</body></worldbody></mujoco>
"""
LEG = """
<body name="{side}_thigh" pos="{x} 0 0"><joint type="ball" range="0 150" limited="true"/>
<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".04"/>
<body name="{side}_shin" pos="0 0 -.4"><joint axis="-1 0 0" range="0 150"/>
<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/>
<body name="{side}_foot" pos="0 0 -.4"><geom size=".05"/></body></body></body>
"""


def walker() -> mujoco.MjModel:
    legs = "".join(LEG.format(side=side, x=x) for side, x in (("left", -0.1), ("right", 0.1)))
    return mujoco.MjModel.from_xml_string(WALKER.format(legs=legs))


@pytest.fixture(scope="module")
def g1_model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf" / "g1.xml"))


@pytest.fixture(scope="module")
def g1(g1_model: mujoco.MjModel) -> Robot:
    return robot_from_model(g1_model, load_robot_mapping("g1"))


def retargeted(name: str, robot: Robot) -> RobotMotion:
    pytest.importorskip("mink")
    return retarget_to_robot(source_from_clip(load_clips(name)[0][0]), robot)


@pytest.mark.parametrize("name", ["humanoid", "humanoid_CMU"])
def test_other_peoples_humanoids_run_on_their_feet(name: str) -> None:
    """dm_control has two, with up to three hinges on a body; one has toes."""
    pytest.importorskip("mink")
    prepared = load_robot(file_of_package(f"dm_control/suite/{name}.xml"))
    mapping = recognise_robot(prepared.model, prepared.start_qpos)
    robot = robot_from_model(prepared.model, mapping, prepared.start_qpos)
    clip = cut(load_clips("run")[0][0], 0.0, 0.5)
    report = retarget_to_robot(source_from_clip(clip), robot).report
    assert report.deepest_m < 0.01
    assert report.slide_m_s is not None
    assert report.slide_m_s[1] < 0.05
    assert max(mean for key, (mean, _) in report.errors_m.items() if key != "head") < 0.03


def corners(model: mujoco.MjModel, qpos: np.ndarray, geom: str) -> np.ndarray:
    """Return the world places (T, 8, 3) of a box's corners, by MuJoCo's kinematics."""
    data, box = mujoco.MjData(model), model.geom(geom)
    local = np.array(list(itertools.product((-1, 1), repeat=3))) * box.size
    places = []
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        places.append(local @ data.geom(geom).xmat.reshape(3, 3).T + data.geom(geom).xpos)
    return np.stack(places)


@pytest.mark.parametrize("name", ["run", "sidestep_left"])
def test_feet_of_the_g1_rest_where_the_source_rests(g1_model, g1, humanoid, name) -> None:
    clip = load_clips(name)[0][0]
    motion = retargeted(name, g1)
    source = sole_corners(humanoid, *clip.global_poses())
    speed = np.linalg.norm(np.diff(source, axis=0), axis=-1) * clip.fps
    flat = (speed < 0.02) & (source[1:, ..., 2] < 1e-3) & (source[:-1, ..., 2] < 1e-3)
    for side, geom in enumerate(("right_foot", "left_foot")):
        places = corners(g1_model, motion.qpos, geom)
        assert places[..., 2].min() > -1e-4
        stands = flat[:, side].all(axis=-1)  # all four corners of the source's sole are at rest
        assert stands.any()
        bottom = np.sort(places[..., 2], axis=1)[1:][stands][:, :4]
        assert bottom.max() < 0.005
        sliding = np.linalg.norm(np.diff(places[..., :2], axis=0), axis=-1)[stands] * clip.fps
        assert sliding.max() < 0.05


def test_the_g1_moves_within_its_limits_and_as_reported(g1_model, g1) -> None:
    clip = load_clips("walk")[0][0]
    motion = retargeted("walk", g1)
    assert motion.fps == clip.fps
    assert motion.qpos.shape == (clip.num_frames, g1_model.nq)
    lower, upper = g1_model.jnt_range[1:].T
    assert (motion.qpos[:, 7:] > lower - 1e-6).all()
    assert (motion.qpos[:, 7:] < upper + 1e-6).all()
    speed = np.abs(np.diff(motion.qpos[:, 7:], axis=0)).max() * motion.fps
    assert speed == pytest.approx(motion.report.fastest_rad_s)
    assert speed < 20.0
    # Legs of 0.623 m by 0.832 m.
    assert motion.report.scale == pytest.approx(0.749, abs=1e-3)
    way, own_way = clip.root_translation[-1, 0] - clip.root_translation[0, 0], 0.749
    assert motion.qpos[-1, 0] - motion.qpos[0, 0] == pytest.approx(own_way * way, rel=0.01)
    assert max(largest for _, largest in motion.report.errors_m.values()) < 0.02
    assert motion.report.deepest_m < 1e-6
    # Knees bend forwards, elbows too.
    for side, joint in itertools.product(("left", "right"), ("knee", "elbow")):
        angle = motion.qpos[:, g1_model.joint(f"{side}_{joint}_joint").qposadr[0]]
        assert angle.min() > 0.0 if joint == "knee" else angle.max() < 1.45


def test_a_robot_that_faces_another_way_walks_where_the_source_walks() -> None:
    mapping, line = guess_robot_mapping(walker())
    assert "left_foot: left_foot" in line
    robot = robot_from_model(walker(), mapping)
    motion = retargeted("walk", robot)
    clip = load_clips("walk")[0][0]
    way = (clip.root_translation[-1] - clip.root_translation[0]) * motion.report.scale
    moved = motion.qpos[-1, :3] - motion.qpos[0, :3]
    np.testing.assert_allclose(moved[:2], way[:2], atol=0.05)
    # Ball hips keep within 150 deg of the zero pose; feet are balls of 5 cm on the ground.
    for joint in (1, 3):
        column = robot.model.jnt_qposadr[joint]
        assert 2.0 * np.arccos(np.abs(motion.qpos[:, column])).max() < np.radians(150.0)
    assert motion.report.slide_m_s is not None
    assert motion.report.slide_m_s[1] < 0.05
    lowest = robot.soles(motion.qpos)[..., 2].min(axis=(1, 2))
    assert lowest.min() > -1e-6


def test_names_alone_give_the_shipped_mapping_of_the_g1(g1_model) -> None:
    mapping, _ = guess_robot_mapping(g1_model)
    assert {name: entry.body for name, entry in mapping.bodies.items()} == VALID["bodies"]


def test_a_robot_without_legs_is_told_what_to_write() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="torso"><freejoint/><geom size=".1"/></body></worldbody>'
        "</mujoco>"
    )
    with pytest.raises(ConfigError, match=r"cannot find right_thigh.*left_foot: <body>.*: torso"):
        guess_robot_mapping(model)


def test_a_sole_is_made_of_boxes_balls_and_capsules() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="foot" pos="0 0 1"><freejoint/>
        <geom type="box" size=".1 .05 .02" pos="0 0 -.03"/>
        <geom type="capsule" fromto="-.1 0 -.02 .1 0 -.02" size=".03"/>
        <geom type="sphere" size=".01"/>
        <geom type="sphere" size=".2" contype="0" conaffinity="0"/>
        </body></worldbody></mujoco>"""
    )
    points, radii = find_sole(model, model.qpos0, "foot")
    # The lower corners of the box, and both ends of the capsule: all reach down to -0.05 m.
    assert len(points) == 6
    np.testing.assert_allclose(points[:, 2] - radii, -0.05, atol=1e-6)
    assert sorted(radii.tolist()) == pytest.approx([0, 0, 0, 0, 0.03, 0.03])


def write(folder: Path, **changes) -> Path:
    path = folder / "robot.yaml"
    content = {**VALID, **changes}
    path.write_text(yaml.safe_dump({k: v for k, v in content.items() if v is not None}))
    return path


def bodies(**changes) -> dict:
    entries = {**VALID["bodies"], **changes}
    return {body: entry for body, entry in entries.items() if entry is not None}


def test_mistakes_in_a_mapping_are_one_line(tmp_path, g1_model) -> None:
    for changes, message in (
        ({"bodies": None}, "has no bodies; guess_robot_mapping"),
        ({"bodies": bodies(tail="tail")}, r"unknown body 'tail'.*choices: head"),
        ({"bodies": bodies(left_lower_arm=None)}, "bodies lacks left_lower_arm"),
        (
            {"bodies": bodies(left_hand={"body": "x", "rotation": 1})},
            "source has rotations only of",
        ),
        ({"bodies": bodies(left_hand="left_palm")}, r"body of the robot 'left_palm'.*choices"),
        ({"bodies": bodies(left_hand="torso_link")}, "bodies.torso are both 'torso_link'"),
        ({"start_pose": "sit"}, r"unknown key of the robot 'sit'.*home"),
    ):
        with pytest.raises(ConfigError, match=message) as caught:
            robot_from_model(g1_model, load_robot_mapping(write(tmp_path, **changes)))
        assert "\n" not in str(caught.value)


def test_joints_that_retargeting_cannot_move_are_refused() -> None:
    mapping, _ = guess_robot_mapping(walker())
    rail = '<body name="b"><joint type="slide" name="rail"/><geom size=".1"/></body>'
    with pytest.raises(ConfigError, match=r"joint 'rail' .* is a slide joint"):
        robot_from_model(mujoco.MjModel.from_xml_string(WALKER.format(legs=rail)), mapping)


def test_a_clip_of_no_humanoid_is_refused(make_humanoid_clip) -> None:
    clip = make_humanoid_clip(num_frames=3)
    names = tuple(f"link{i}" for i in range(clip.num_bodies))
    with pytest.raises(MotionFileError, match="no shipped humanoid has its 15 bodies"):
        source_from_clip(dataclasses.replace(clip, body_names=names))


def test_joints_alone_give_the_bodies_of_the_g1(g1_model) -> None:
    """The names have no meaning; thighs and upper arms are the links before knee and elbow."""
    spec = mujoco.MjSpec.from_file(str(paths.assets_dir() / "mjcf/g1.xml"))
    for number, body in enumerate(spec.bodies[1:], start=1):
        body.name = f"part{number}"
    for number, joint in enumerate(spec.joints):
        joint.name = f"axis{number}"
    for thing in [*spec.actuators, *spec.sensors, *spec.excludes]:
        spec.delete(thing)
    nameless = spec.compile()
    mapping, line = guess_robot_mapping(nameless, nameless.key("home").qpos)
    assert line.startswith("bodies by their joints: ")
    wanted = {
        **{"pelvis": "pelvis", "torso": "torso_link"},
        **{
            f"{side}_{part}": f"{side}_{link}_link"
            for side in ("left", "right")
            for part, link in (
                *(("thigh", "hip_yaw"), ("shin", "knee"), ("foot", "ankle_roll")),
                *(("upper_arm", "shoulder_yaw"), ("lower_arm", "elbow"), ("hand", "wrist_yaw")),
            )
        },
    }
    numbers = {name: f"part{g1_model.body(body).id}" for name, body in wanted.items()}
    assert {name: entry.body for name, entry in mapping.bodies.items()} == numbers


def test_a_quadruped_is_not_taken_for_a_humanoid() -> None:
    robot = load_robot(paths.assets_dir() / "mjcf/quadruped.xml")
    with pytest.raises(ConfigError, match="cannot find"):
        guess_robot_mapping(robot.model, robot.start_qpos)


def test_a_foot_of_a_frame_is_the_link_that_carries_it(g1_model) -> None:
    text = (paths.assets_dir() / "mjcf/g1.xml").read_text()
    spec = mujoco.MjSpec.from_string(text)
    spec.body("left_ankle_roll_link").add_body(name="left_foot_frame", pos=(0.05, 0, -0.03))
    mapping, _ = guess_robot_mapping(spec.compile())
    assert mapping.bodies["left_foot"].body == "left_ankle_roll_link"


def test_a_robot_with_long_feet_stands_on_them(g1_model) -> None:
    """Its toes go below the ground when the source rolls over its shorter toes."""
    spec = mujoco.MjSpec.from_file(str(paths.assets_dir() / "mjcf/g1.xml"))
    sole, _ = find_sole(g1_model, g1_model.key("home").qpos, "left_ankle_roll_link")
    for side in ("left", "right"):
        spec.body(f"{side}_ankle_roll_link").add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(0.17, 0.03, 0.005),
            pos=(0.08, 0.0, sole[:, 2].min() + 0.005),
        )
    model = spec.compile()
    robot = robot_from_model(model, load_robot_mapping("g1"), model.key("home").qpos)
    report = retargeted("walk", robot).report
    assert report.slide_m_s is not None
    assert report.slide_m_s[1] < 0.05
    assert report.deepest_m < 1e-6
