from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.rendering.markers import RobotOverlay
from isaacgymenvs_lite.rendering.tracks import PoseReader
from isaacgymenvs_lite.viewers.reference_overlay import ReferenceOverlay


@pytest.fixture
def env(make_env, walk_clip):
    env = make_env("task=HumanoidAMP", "num_envs=2", f"task.env.motion_file={walk_clip}")
    env.reset()
    return env


def put_into_clip(env, time_s: float) -> None:
    """Put both humanoids into the clip's pose at a time, without physics."""
    rows = torch.arange(2)
    state = env.motion_lib.get_motion_state(0 * rows, torch.full((2,), time_s))
    roots = torch.cat(state[:2] + state[3:5], dim=-1)
    env.simulation.write_state(rows, roots, state.dof_pos, state.dof_vel)


def test_it_goes_beside_a_character_that_imitates_perfectly(env):
    overlay, read = ReferenceOverlay(env, env.simulation.model), PoseReader(env)
    for episode, begin_s in enumerate((0.2, 0.6)):
        for step in range(20):
            env.progress_buf[:] = step + 1
            put_into_clip(env, begin_s + step * env.dt)
            qpos = read(0)
            pose = overlay.pose(qpos)
            np.testing.assert_allclose(pose[:2] - qpos[:2], (0.0, 1.0))
            # half a control step of the clip at most, whose joints turn at some rad/s
            assert np.abs(pose[7:] - qpos[7:]).max() < 0.05, (episode, step)


def test_it_is_a_translucent_robot(env):
    model = env.simulation.model
    scene = mujoco.MjvScene(model, 100)
    qpos = model.qpos0.copy()
    qpos[:3] = (3.0, 1.0, 0.9)
    RobotOverlay(model).add_to(scene, qpos)
    geoms = scene.geoms[: scene.ngeom]
    assert len(geoms) == (model.geom_bodyid > 0).sum()
    assert {round(float(geom.rgba[3]), 2) for geom in geoms} == {0.35}
    places = np.array([geom.pos for geom in geoms])
    np.testing.assert_allclose(places[:, :2].mean(axis=0), (3.0, 1.0), atol=0.2)
