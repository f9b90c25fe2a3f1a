"""Gaits of quadrupeds, measured by MuJoCo's kinematics."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.clip import JointClip
from isaacgymenvs_lite.motion.formats.robot_clip import read_joint_clip
from isaacgymenvs_lite.motion.gait import GaitSettings, find_legs, main, make_gait, write_gait
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot

MJCF = paths.assets_dir() / "mjcf"
FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
RADIUS = 0.022  # of the quadruped's feet
SHIPPED = GaitSettings(speed=1.0, frequency=2.5, bounce=0.005)
LEG = """
  <body pos="{x} {y} 0"><joint axis="1 0 0"/><geom size="0.02"/>
    <body><joint axis="0 1 0"/><geom size="0.02"/>
      <body pos="0 0 -0.2"><joint name="{name}_knee" axis="0 1 0"/><geom size="0.02"/>
        <body name="{name}" pos="0 0 -0.2"><geom size="0.02"/></body></body></body></body>
"""


@pytest.fixture(scope="module")
def robot() -> PreparedRobot:
    return load_robot(MJCF / "quadruped.xml")


def feet_of(robot: PreparedRobot, clip: JointClip) -> np.ndarray:
    """Centres (T, 4, 3) m of the feet's balls."""
    data = mujoco.MjData(robot.model)
    geoms = [robot.model.geom(name).id for name in FEET]
    centres = []
    for place, angles in zip(clip.root_pos, clip.dof_pos, strict=True):
        data.qpos[:3], data.qpos[7:] = place, angles
        mujoco.mj_kinematics(robot.model, data)
        centres.append(data.geom_xpos[geoms])
    return np.stack(centres)


def on_ground(feet: np.ndarray) -> np.ndarray:
    return feet[..., 2] < RADIUS + 1e-6


@pytest.mark.parametrize(
    ("gait", "duty", "least", "together"),
    [("trot", 0.5, 2, ((0, 3), (1, 2))), ("walk", 0.75, 3, ())],
)
def test_feet_in_stance_stay_on_the_ground(robot, gait, duty, least, together) -> None:
    settings = GaitSettings(gait=gait, speed=0.6, frequency=2.0, seconds=1.0)
    feet = feet_of(robot, make_gait(robot, settings))
    down = on_ground(feet)
    assert feet[..., 2].min() > RADIUS - 1e-6
    assert feet[..., 2].max() == pytest.approx(RADIUS + settings.step_height, abs=2e-3)
    moved = np.linalg.norm(np.diff(feet, axis=0), axis=-1)
    assert moved[down[1:] & down[:-1]].max() < 2e-6  # twice the solver's tolerance
    assert moved.max() > 0.01
    # Both ends of a stance are frames: a stance has one frame more than its share of 30.
    np.testing.assert_allclose(down[:-1].mean(axis=0), duty + 1 / 30, atol=1.01 / 30)
    assert down.sum(axis=1).min() == least
    for one, other in together:
        assert (down[:, one] == down[:, other]).all()


def test_knees_by_the_law_of_cosines(robot) -> None:
    clip = make_gait(robot, GaitSettings(speed=0.0, step_height=0.0, body_height=0.3, seconds=0.5))
    knees = clip.dof_pos[:, [2, 5, 8, 11]]
    # Thigh and calf have 0.213 m; the foot's ball is 2 mm behind the calf's end.
    calf, reach = math.hypot(0.213, 0.002), 0.3 - RADIUS
    inner = math.acos((0.213**2 + calf**2 - reach**2) / (2 * 0.213 * calf))
    np.testing.assert_allclose(knees, inner - math.pi - math.atan(0.002 / 0.213), atol=1e-4)
    np.testing.assert_allclose(clip.dof_pos[:, [0, 3, 6, 9]], 0.0, atol=1e-6)


def test_the_shipped_trot_is_what_its_command_makes(robot) -> None:
    clip = make_gait(robot, SHIPPED)
    path = paths.assets_dir() / "amp" / "robot_motions" / "quadruped_trot.npz"
    shipped = read_joint_clip(path)
    assert (shipped.fps, shipped.joint_names) == (clip.fps, clip.joint_names)
    np.testing.assert_allclose(shipped.dof_pos, clip.dof_pos, atol=1e-6)
    np.testing.assert_allclose(shipped.root_pos, clip.root_pos, atol=1e-9)
    lower, upper = robot.model.jnt_range[1:].T
    assert ((clip.dof_pos > lower + 0.5) & (clip.dof_pos < upper - 0.5)).all()
    assert np.abs(np.diff(clip.dof_pos, axis=0)).max() * 60 < 13.0  # rad/s; a Go2 has 30
    read, _ = load_clips("quadruped_trot", Skeleton.from_model(robot.model))[0]
    assert read.num_frames == 241


def test_the_shipped_drives_follow_the_trot(robot) -> None:
    """The clip's angles as targets, without a controller, keep the robot upright and moving."""
    clip, model = make_gait(robot, SHIPPED), robot.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[0] = robot.start_qpos, 1.0
    data.qpos[:3], data.qpos[7:] = clip.root_pos[0], clip.dof_pos[0]
    lowest = 1.0
    while data.time < 3.9:
        data.ctrl[:] = clip.dof_pos[int(60 * data.time)]
        mujoco.mj_step(model, data)
        lowest = min(lowest, data.qpos[2])
    assert lowest > 0.25
    # 3.9 m in the clip; with kd = 0.1 s * kp it comes 1 m far.
    assert data.qpos[0] > 2.7
    assert abs(data.qpos[1]) < 0.5


def quadruped_of(folder: Path, places: dict[str, tuple[float, float]]) -> Path:
    legs = "".join(LEG.format(name=name, x=x, y=y) for name, (x, y) in places.items())
    path = folder / "own.xml"
    path.write_text(
        f'<mujoco><worldbody><body name="trunk" pos="0 0 1"><geom size="0.05"/>{legs}</body>'
        "</worldbody></mujoco>"
    )
    return path


def test_legs_are_found_in_any_order(tmp_path) -> None:
    places = {"a": (-0.3, -0.1), "b": (0.3, 0.1), "c": (-0.3, 0.1), "d": (0.3, -0.1)}
    legs = find_legs(load_robot(quadruped_of(tmp_path, places)))
    assert [leg.foot for leg in legs] == ["b", "d", "c", "a"]
    for leg in legs:
        np.testing.assert_allclose(leg.hip, (*places[leg.foot], 0.0), atol=1e-12)
        assert leg.length == pytest.approx(0.4)
        assert len(leg.joints) == 3


@pytest.mark.parametrize(("knees", "front", "rear"), [("ahead", 1, 1), ("inward", -1, 1)])
def test_knees_bend_to_the_wanted_side(tmp_path, knees, front, rear) -> None:
    places = {"fl": (0.3, 0.1), "fr": (0.3, -0.1), "rl": (-0.3, 0.1), "rr": (-0.3, -0.1)}
    settings = GaitSettings(speed=0.3, seconds=0.5, knees=knees)
    clip = read_joint_clip(
        write_gait(str(quadruped_of(tmp_path, places)), str(tmp_path / "out.npz"), settings)
    )
    # A knee is behind where the shank turns forward: a negative angle about y (to the left).
    angles = clip.dof_pos[:, [2, 5, 8, 11]]
    assert (np.sign(angles) == [front, front, rear, rear]).all()


def test_a_robot_that_looks_along_y_is_turned(tmp_path) -> None:
    places = {"fl": (-0.1, 0.3), "fr": (0.1, 0.3), "rl": (-0.1, -0.3), "rr": (0.1, -0.3)}
    path = quadruped_of(tmp_path, places)
    path.write_text(path.read_text().replace('"0 1 0"', '"-1 0 0"').replace('"1 0 0"', '"0 1 0"'))
    turn = (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5))
    settings = GaitSettings(seconds=0.5, speed=0.3, start_rotation=turn)
    clip = read_joint_clip(write_gait(str(path), str(tmp_path / "out.npz"), settings))
    np.testing.assert_allclose(clip.root_rot, np.tile(turn, (31, 1)), atol=1e-12)
    # The legs are the same as for a robot that looks along x, and swing in their own planes.
    along_x = quadruped_of(tmp_path, {name: (y, -x) for name, (x, y) in places.items()})
    same = make_gait(load_robot(along_x), GaitSettings(seconds=0.5, speed=0.3))
    np.testing.assert_allclose(clip.dof_pos, same.dof_pos, atol=1e-5)


def test_feet_reach_their_places_by_joints_that_follow(tmp_path) -> None:
    places = {"fl": (0.3, 0.1), "fr": (0.3, -0.1), "rl": (-0.3, 0.1), "rr": (-0.3, -0.1)}
    path = quadruped_of(tmp_path, places)
    text, equalities = path.read_text(), ""
    for name in places:
        foot = f'<body name="{name}" pos="0 0 -0.2">'
        text = text.replace(foot, f'{foot}<joint name="{name}_toe" axis="0 1 0" pos="0 0 0.1"/>')
        equalities += f'<joint joint1="{name}_toe" joint2="{name}_knee" polycoef=".1 -.4 .2 0 0"/>'
    path.write_text(text.replace("</mujoco>", f"<equality>{equalities}</equality></mujoco>"))
    robot = load_robot(path)
    clip = make_gait(robot, GaitSettings(speed=0.4, seconds=1.0, step_height=0.05))
    knees, toes = clip.dof_pos[:, [2, 6, 10, 14]], clip.dof_pos[:, [3, 7, 11, 15]]
    np.testing.assert_allclose(toes, 0.1 - 0.4 * knees + 0.2 * knees**2, atol=1e-12)
    data, feet = mujoco.MjData(robot.model), [robot.model.body(name).id for name in places]
    heights = []
    for place, angles in zip(clip.root_pos, clip.dof_pos, strict=True):
        data.qpos[:3], data.qpos[7:] = place, angles
        mujoco.mj_kinematics(robot.model, data)
        heights.append(data.xpos[feet, 2].copy())
    assert np.min(heights, axis=0) == pytest.approx(0.02, abs=2e-6)  # the feet's balls
    assert np.max(heights, axis=0) == pytest.approx(0.07, abs=2e-3)


def test_what_is_refused(tmp_path) -> None:
    for name, settings, message in (
        ("g1", GaitSettings(), "has 2 legs of at least 3 hinges, expected 4"),
        ("quadruped", GaitSettings(body_height=0.6), "its leg is too short"),
        ("quadruped", GaitSettings(frequency=10.0, fps=30.0), "3 frames at fps=30"),
    ):
        with pytest.raises(ConfigError, match=message) as caught:
            write_gait(str(MJCF / f"{name}.xml"), str(tmp_path / "out.npz"), settings)
        assert "\n" not in str(caught.value)
        assert str(caught.value).startswith(str(MJCF / f"{name}.xml"))
        assert not list(tmp_path.iterdir())


def test_command(tmp_path, capsys) -> None:
    out = str(tmp_path / "walk.npz")
    words = [str(MJCF / "anymal.xml"), out, "gait=walk", "speed=0.5", "seconds=0.5"]
    assert main(words) == 0
    assert read_joint_clip(out).num_frames == 31
    with pytest.raises(SystemExit):
        main(words)
    assert "exists already; overwrite=True" in capsys.readouterr().err
    with pytest.raises(MotionFileError, match="the suffix determines"):
        write_gait(words[0], str(tmp_path / "walk.csv"), GaitSettings())
