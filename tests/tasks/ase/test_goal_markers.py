"""What pictures show of the goals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.rendering.markers import Arrow, Sphere
from isaacgymenvs_lite.rendering.tracks import PoseRecorder


def start(make_ase, goal: str):
    torch.manual_seed(0)
    task = make_ase(2, goal=goal)
    task.reset()
    task.step(torch.zeros(task.num_envs, task.num_actions))
    return task


def check_arrow(arrow: Arrow, xy: torch.Tensor, direction: torch.Tensor) -> None:
    """It begins beside the character and points where it shall."""
    start, end = np.array(arrow.start_w), np.array(arrow.end_w)
    assert np.linalg.norm(start[:2] - xy.numpy()) == pytest.approx(0.3, abs=1e-5)
    np.testing.assert_allclose((end - start)[:2] / 0.7, direction.numpy(), atol=1e-5)
    assert start[2] == end[2] == pytest.approx(0.03)


def test_heading_shows_where_to_go_and_where_to_face(make_ase) -> None:
    task = start(make_ase, "heading")
    xy = task.simulation.root_states[1, :2]
    go, face = task.markers(1)
    check_arrow(go, xy, task.goal.tar_dir[1])
    check_arrow(face, xy, task.goal.tar_face_dir[1])
    assert go.colour != face.colour


def test_location_shows_the_point_and_the_way(make_ase) -> None:
    task = start(make_ase, "location")
    point, way = task.markers(1)
    assert isinstance(point, Sphere)
    assert point.centre_w[:2] == pytest.approx(task.goal.tar_pos[1].tolist())
    assert point.radius_m == pytest.approx(math.sqrt(0.5))  # what counts as reached
    xy = task.simulation.root_states[1, :2]
    offset = task.goal.tar_pos[1] - xy
    check_arrow(way, xy, offset / offset.norm())


def test_reach_shows_the_point(make_ase) -> None:
    task = start(make_ase, "reach")
    (point,) = task.markers(1)
    assert point.centre_w == pytest.approx(task.goal.tar_pos[1].tolist())


def test_a_recorder_keeps_the_marks_of_its_environments(make_ase) -> None:
    task = start(make_ase, "heading")
    recorder = PoseRecorder(task, num_steps=2, env_ids=(1, 0))
    seen = []
    for _ in range(3):
        seen.append((task.markers(1), task.markers(0)))
        recorder.step()
        task.step(torch.zeros(task.num_envs, task.num_actions))
    assert recorder.markers() == seen[:2]
