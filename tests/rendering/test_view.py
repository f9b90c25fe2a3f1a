from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.rendering.scene import SceneRenderer, TerrainWindow
from isaacgymenvs_lite.rendering.view import View

ROBOT = """<body pos="0 0 {height}"><freejoint/><geom type="box" size=".3 .2 .1"/></body>"""
CART = """<body pos="0 0 2"><joint type="slide"/><geom type="box" size=".1 4 .1"/></body>"""


def model_of(body: str, ground: str = "<geom type='plane' size='0 0 1'/>") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><hfield name="hills" nrow="61" ncol="101" size="50 30 4 1"/></asset>
        <worldbody><light pos="0 0 6" directional="true"/>{ground}{body}</worldbody></mujoco>"""
    )


def test_a_robot_is_seen_from_its_side_with_room_about_it():
    flat = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{ROBOT.format(height=0.1)}</worldbody></mujoco>"
    )
    view = View.of_model(flat)
    assert (view.azimuth_deg, view.moves_about, view.flies) == (90.0, True, False)
    assert view.look_at_height_m == pytest.approx(0.1)
    assert view.distance_m == 1.6  # as near as a camera comes


def test_a_long_robot_fits_into_a_narrow_picture():
    long = ROBOT.format(height=0.5).replace('pos="0', 'pos="7').replace(".3 .2", "1 .2")
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{long}</worldbody></mujoco>")
    view = View.of_model(model, aspect=0.5)
    seen_m = 2 * view.distance_m * np.tan(np.deg2rad(45 / 2)) * 0.5
    assert 2.5 < seen_m < 3.0  # of 2 m


def test_a_robot_above_the_ground_is_gone_along_with_in_height():
    flat = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{ROBOT.format(height=1.0)}</worldbody></mujoco>"
    )
    view = View.of_model(flat)
    assert (view.flies, view.look_at_height_m) == (True, 0.0)


def test_what_is_fixed_is_seen_across_its_longer_side():
    view = View.of_model(
        mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{CART}</worldbody></mujoco>")
    )
    assert (view.azimuth_deg, view.moves_about, view.look_at_height_m) == (180.0, False, 2.0)
    assert view.distance_m > 8.0  # 8 m wide


@pytest.fixture
def hills() -> mujoco.MjModel:
    """A slope along x, 0 at x = -50 m and 4 m at x = 50 m."""
    model = model_of(ROBOT.format(height=1.0), "<geom type='hfield' hfield='hills'/>")
    model.hfield_data[:] = np.tile(np.linspace(0.0, 1.0, 101), 61)
    return model


def test_the_height_of_the_ground(hills):
    window = TerrainWindow(hills)
    window.move(np.array((20.0, -10.0)))  # what is drawn does not matter
    for x in (-50.0, -20.0, 0.0, 30.0):
        expected = max(0.02, 4.0 * (x + 50.0) / 100.0)  # at the edge the mean of what is there
        assert window.height(np.array((x, 3.0))) == pytest.approx(expected, abs=0.021)


def test_a_piece_of_the_ground_is_where_it_was(hills):
    """Rays from above hit the piece where they hit the whole."""
    places = [(12.0, 5.5), (14.5, -3.0), (8.0, 0.5)]

    def heights(model: mujoco.MjModel) -> list[float]:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        down, geom = np.array((0.0, 0.0, -1.0)), np.zeros(1, np.int32)
        starts = [np.array((*place, 20.0)) for place in places]
        args = (None, 1, 1, geom)
        return [20.0 - mujoco.mj_ray(model, data, start, down, *args) for start in starts]

    whole = heights(hills)
    window = TerrainWindow(hills)
    assert window.move(np.array((11.0, 1.0)))
    assert int(hills.hfield_nrow[0]) < 40
    np.testing.assert_allclose(heights(hills), whole, atol=1e-6)
    assert not window.move(np.array((12.0, 2.0)))  # still well within
    assert window.move(np.array((40.0, 25.0)))  # near the edge of the whole: a smaller piece


def test_a_picture_on_a_slope_shows_the_robot_where_the_ground_is(gl, hills):
    pictures = []
    with SceneRenderer(hills, 120, 120, view=View.of_model(hills)) as renderer:
        for x in (-20.0, 30.0):
            height = 4.0 * (x + 50.0) / 100.0
            pictures.append(renderer.draw((x, 0.0, height + 0.1, 1.0, 0.0, 0.0, 0.0)))
    first, second = (picture.astype(int) for picture in pictures)
    assert first.std() > 10
    assert np.abs(first - second).mean() < 12  # the same but for the ground farther away
