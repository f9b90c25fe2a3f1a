"""Heights of start poses, compared with MuJoCo's own contacts and distances."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.robots.load import load_robot, prepare_robot
from isaacgymenvs_lite.robots.start_pose import CLEARANCE, start_height
from tests.robots.texts import TETRAHEDRON, mjcf, written

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
