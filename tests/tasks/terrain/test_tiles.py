"""Kinds of ground: heights of single samples by hand, in units of 0.005 m on a grid of 0.1 m."""

from __future__ import annotations

import numpy as np
import pytest

from isaacgymenvs_lite.tasks.terrain.grid import (
    discrete_obstacles,
    middle,
    pyramid_slope,
    pyramid_stairs,
    roughness,
    samples_of,
    stepping_stones,
    units_of,
)

SIZE = (80, 80)


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_lengths_and_heights_are_rounded_down() -> None:
    assert [samples_of(v) for v in (8.0, 0.31, 3.0, 0.3, 0.01)] == [80, 3, 30, 3, 1]
    # 0.0675 m is 13.5 units; 0.085 m is 17, which 0.085 / 0.005 misses by a bit.
    assert [units_of(v) for v in (0.0675, -0.0675, 0.085, -0.05)] == [13, -13, 17, -10]


def test_a_pyramid_rises_by_its_slope_and_has_a_flat_top() -> None:
    heights = pyramid_slope(SIZE, 0.2, 3.0)
    # The peak would be 0.2 * 4 m = 160 units. Half of the way in x, on the middle in y: 80, but the
    # platform's corner at 25/40 of both ways cuts off at 160 * (25/40)^2 = 62.5.
    assert heights[0].max() == heights[:, 0].max() == 0
    assert heights[10, 40] == 40
    assert heights[10, 20] == 20
    assert heights[40, 40] == heights[20, 40] == heights[25, 25] == heights.max() == 62
    assert (heights[middle(SIZE, 3.0)] == 62).all()
    # Along the middle: 0.2 m per m.
    assert np.diff(heights[:15, 40]).tolist() == [4] * 14


def test_a_negative_slope_is_a_pit() -> None:
    assert np.array_equal(pyramid_slope(SIZE, -0.2, 3.0), -pyramid_slope(SIZE, 0.2, 3.0))


def test_stairs_are_rings_up_to_the_platform() -> None:
    heights = pyramid_stairs(SIZE, 0.31, 0.0675, 3.0)
    # Rings of 3 samples and 13 units; after 9 of them 80 - 2 * 27 = 26 samples are left, not 30.
    assert heights[[2, 3, 5, 6, 26, 27, 40], 40].tolist() == [0, 13, 13, 26, 104, 117, 117]
    assert heights.max() == 117
    assert np.array_equal(heights, heights[::-1])
    assert np.array_equal(heights, heights.T)
    assert np.array_equal(pyramid_stairs(SIZE, 0.31, -0.0675, 3.0), -heights)


def test_obstacles_have_four_heights_and_leave_the_middle_free() -> None:
    heights = discrete_obstacles(SIZE, _rng(), 0.1, (1.0, 2.0), 40, 3.0)
    assert set(np.unique(heights)) == {-20, -10, 0, 10, 20}
    assert (heights[25:55, 25:55] == 0).all()
    assert (heights != 0).mean() > 0.2


def test_stepping_stones_have_holes_around_them_but_not_in_the_middle() -> None:
    heights = stepping_stones(SIZE, _rng(), 0.5, 0.1, 3.0)
    assert set(np.unique(heights)) == {0, -2000}
    assert (heights[25:55, 25:55] == 0).all()
    # Rows of 5 samples with a gap of 1; stones of 5 with a gap of 1 along them.
    assert (heights[5] == -2000).all()
    assert (heights[0] == 0).sum() == pytest.approx(80 * 5 / 6, abs=1)
    holes = np.flatnonzero(heights[0] != 0)
    assert set(np.diff(holes)) == {6}


def test_roughness_has_steps_on_a_coarse_grid_and_is_linear_in_between() -> None:
    heights = roughness(SIZE, _rng(), 0.1, 0.025, 0.2)
    assert heights.shape == SIZE
    assert np.abs(heights).max() <= 20
    corners = heights[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners % 5 == 0).all()
    # 40 coarse samples over 80: neighbours differ by at most 39/79 of the 40 units of the range.
    assert np.abs(np.diff(heights.astype(int), axis=0)).max() <= 21
    assert heights.std() > 3.0
    assert len(np.unique(heights)) > 20
