from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.rendering.markers import Arrow, Sphere
from isaacgymenvs_lite.rendering.scene import Image, SceneRenderer
from isaacgymenvs_lite.rendering.view import View

pytestmark = pytest.mark.usefixtures("gl")


def figure(image: Image) -> np.ndarray:
    """Where something coloured is: the character, not the floor or the sky."""
    pixels = image.astype(int)
    return pixels.max(axis=2) - pixels.min(axis=2) > 70


def test_a_pose_is_drawn(humanoid):
    with SceneRenderer(humanoid, 120, 160) as renderer:
        image = renderer.draw(humanoid.qpos0)
    assert image.shape == (160, 120, 3)
    assert image.dtype == np.uint8
    assert image.mean() > 100  # a bright scene
    assert 0.03 < figure(image).mean() < 0.5


def test_pictures_are_not_overwritten_by_the_next(humanoid):
    bent = humanoid.qpos0.copy()
    bent[humanoid.joint("right_knee").qposadr[0]] = 1.5
    with SceneRenderer(humanoid, 120, 160) as renderer:
        first = renderer.draw(humanoid.qpos0)
        kept = first.copy()
        assert (renderer.draw(bent) != first).any()
    assert (first == kept).all()


@pytest.mark.parametrize("fast", [True, False])
def test_the_camera_goes_along(fast, humanoid):
    away = humanoid.qpos0.copy()
    away[:2] += (30.0, -12.0)
    with SceneRenderer(humanoid, 120, 160, fast=fast) as renderer:
        here, there = (figure(renderer.draw(qpos)) for qpos in (humanoid.qpos0, away))
    # the same pixels, but for some at the edges
    assert (here & there).sum() > 0.9 * (here | there).sum()


def test_floor_and_shadow_go_along(humanoid):
    """Far away nothing is missing; towards the light there was noise on the floor."""
    far, near = humanoid.qpos0.copy(), humanoid.qpos0.copy()
    far[:2] += 100.0, 40.0  # whole squares of the floor
    near[:2] -= 4.0
    with SceneRenderer(humanoid, 120, 160) as renderer:
        here, *others = (renderer.draw(q).astype(int) for q in (humanoid.qpos0, far, near))
    for there in others:
        assert (np.abs(here - there).max(axis=2) > 20).mean() < 0.01


def test_the_azimuth_turns_the_view(humanoid):
    """From the right the left limbs, which are green, are hidden; from the front they are not."""
    green = []
    for azimuth_deg in (90.0, 180.0):
        view = View(azimuth_deg=azimuth_deg)
        with SceneRenderer(humanoid, 120, 160, view=view) as renderer:
            image = renderer.draw(humanoid.qpos0).astype(int)
        green.append((image[..., 1] > image[..., [0, 2]].max(axis=2) + 15).sum())
    assert green[1] > 3 * green[0] + 50


@pytest.mark.parametrize("azimuth_deg", [90, 225])
def test_nothing_is_on_the_floor_but_shadows(azimuth_deg, humanoid):
    """The map of shadows made black speckles of the floor that is far away, towards the light."""
    below = humanoid.qpos0.copy()
    below[2] = -30.0
    with SceneRenderer(humanoid, 120, 160, view=View(azimuth_deg=azimuth_deg)) as renderer:
        floor = renderer.draw(below, look_at=humanoid.qpos0)[80:]
    assert (floor.max(axis=2) < 120).sum() <= 2


def test_a_label_stands_whole_in_the_upper_left_corner(humanoid):
    with SceneRenderer(humanoid, 640, 480, view=View(200.0, -20.0)) as renderer:
        plain, labelled = (renderer.draw(humanoid.qpos0, text) for text in ("", "policy"))
    rows, columns = (plain != labelled).any(axis=2).nonzero()
    assert len(rows) > 100
    assert 0 < rows.min() < rows.max() < 40
    assert 0 < columns.min() < columns.max() < 120


def test_a_model_fixed_to_the_world_is_drawn_whole():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><light pos="0 0 4"/><body name="cart"><joint type="slide"/>
        <geom size=".3" rgba="1 0 0 1"/></body></worldbody></mujoco>"""
    )
    with SceneRenderer(model, 120, 120) as renderer:
        first, moved = renderer.draw([0.0]), renderer.draw([0.2])
    assert 0.05 < figure(first).mean() < 0.9
    assert (first != moved).any()


def test_the_model_is_not_changed(humanoid):
    before = humanoid.vis.global_.offwidth, humanoid.vis.quality.shadowsize
    renderer = SceneRenderer(humanoid, 64, 48, fast=True)
    renderer.close()
    renderer.close()  # once more does no harm
    assert (humanoid.vis.global_.offwidth, humanoid.vis.quality.shadowsize) == before


def test_marks_are_drawn_for_one_picture(humanoid):
    away = humanoid.qpos0.copy()
    away[2] = -10.0  # below the ground
    red, yellow = (1.0, 0.0, 0.0), (1.0, 1.0, 0.0)
    markers = (
        Arrow((-0.6, 0.0, 1.2), (-0.1, 0.0, 1.2), red),
        Sphere((0.4, 0.0, 0.6), 0.2, yellow),
    )
    with SceneRenderer(humanoid, 160, 160) as renderer:
        plain, marked, again = (
            renderer.draw(away, markers=m).astype(int) for m in ((), markers, ())
        )
    assert (plain == again).all()
    changed = (plain != marked).any(axis=2)
    r, g, b = np.moveaxis(marked, 2, 0)
    is_red = changed & (r > 100) & (g < r // 2) & (b < r // 2)
    is_yellow = changed & (r > 100) & (g > 100) & (b < r // 2)
    # From the right side x points to the right: the arrow is to the left of the ball, above it.
    (red_row, red_column), (row, column) = (
        np.argwhere(where).mean(axis=0) for where in (is_red, is_yellow)
    )
    assert red_column < 80 < column
    assert red_row < row
    # A ball of 0.2 m at 2.5 m under 45 degrees of view: 77 pixels a metre.
    assert is_yellow.sum() == pytest.approx(np.pi * (0.2 * 77) ** 2, rel=0.3)
