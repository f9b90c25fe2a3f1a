"""The grid of tiles: which kind is where, how hard it is, and that the physics stands on it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.schema import read_section
from isaacgymenvs_lite.tasks.terrain.grid import (
    Terrain,
    TerrainConfig,
    add_height_field,
    make_terrain,
    pyramid_slope,
    pyramid_stairs,
)

TILE = (80, 80)


def _make(seed: int = 0, **keys) -> Terrain:
    cfg = read_section(TerrainConfig, keys, "task.env.terrain")
    return make_terrain(cfg, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def published() -> Terrain:
    """Return the ground of the default configuration."""
    return _make()


def _tile(terrain: Terrain, level: int, kind: int) -> np.ndarray:
    x, y = 200 + 80 * level, 200 + 80 * kind
    return terrain.samples[x : x + 80, y : y + 80].astype(int)


def test_size_and_border_of_the_specification(published: Terrain) -> None:
    assert published.samples.shape == (1200, 2000)
    assert published.border_m == pytest.approx(20.0)
    assert not published.samples[:200].any()
    assert not published.samples[-200:].any()
    assert not published.samples[:, :200].any()
    assert not published.samples[:, -200:].any()


def test_columns_of_the_specification(published: Terrain) -> None:
    for level in [0, 3, 9]:
        slope, step = 0.4 * level / 10, 0.05 + 0.175 * level / 10
        for kind in range(20):
            tile = _tile(published, level, kind)
            if kind < 2:
                sign = -1 if kind == 0 else 1
                assert np.array_equal(tile, pyramid_slope(TILE, sign * slope, 3.0))
            elif kind < 4:
                sign = -1 if kind == 2 else 1
                noise = tile - pyramid_slope(TILE, sign * slope, 3.0)
                assert 10 < np.abs(noise).max() <= 20
            elif kind < 16:
                sign = -1 if kind < 11 else 1
                assert np.array_equal(tile, pyramid_stairs(TILE, 0.31, sign * step, 3.0))
            else:
                top = int((0.025 + 0.15 * level / 10) / 0.005 + 1e-6)
                assert set(np.unique(tile)) == {-top, -(top // 2), 0, top // 2, top}


def test_origins_are_the_middles_at_the_highest_sample_around(published: Terrain) -> None:
    assert published.origins.shape == (10, 20, 3)
    assert published.origins[3, 5, :2].tolist() == [28.0, 44.0]
    for level, kind in ((0, 0), (9, 1), (5, 3), (9, 11), (9, 4)):
        around = _tile(published, level, kind)[30:50, 30:50]
        assert published.origins[level, kind, 2] == pytest.approx(0.005 * around.max())
    # The platform of stairs of 0.05 + 0.175 * 0.9 m = 41 units, after nine of them.
    assert published.origins[9, 11, 2] == pytest.approx(9 * 41 * 0.005)
    assert published.origins[9, 4, 2] == pytest.approx(-9 * 41 * 0.005)


def test_the_seed_decides() -> None:
    def samples(seed: int) -> bytes:
        return _make(seed, numLevels=1, numTerrains=5).samples.tobytes()

    assert samples(1) == samples(1) != samples(2)


def _ground(terrain: Terrain) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><geom name="floor" type="plane" size="0 0 0.05"/></worldbody></mujoco>'
    )
    add_height_field(spec, terrain)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def _height_at(model: mujoco.MjModel, data: mujoco.MjData, x: float, y: float) -> float:
    """Return the height of the ground (m) by a ray from above."""
    geom = np.zeros(1, dtype=np.int32)
    distance = mujoco.mj_ray(
        model, data, np.array([x, y, 50.0]), np.array([0.0, 0.0, -1.0]), None, 1, -1, geom
    )
    assert geom[0] == model.geom("floor").id
    return 50.0 - distance


def test_the_physics_has_the_samples_where_they_belong() -> None:
    terrain = _make(numLevels=2, numTerrains=5, borderSize=2.0, maxInitMapLevel=1)
    model, data = _ground(terrain)
    rng = np.random.default_rng(0)
    rows, columns = (rng.integers(1, n - 1, 50) for n in terrain.samples.shape)
    for i, j in zip(rows, columns, strict=True):
        # A hair beside the sample, as a ray may miss the common corner of triangles: on slopes of
        # at most 0.225 m over 0.1 m this moves the height by 2e-5 m.
        height = _height_at(model, data, 0.1 * i - 2.0 + 5e-6, 0.1 * j - 2.0 + 5e-6)
        assert height == pytest.approx(0.005 * terrain.samples[i, j], abs=1e-4)
    for level in range(2):
        for kind in (0, 4):
            x, y, z = terrain.origins[level, kind]
            assert _height_at(model, data, x + 1e-5, y + 1e-5) <= z + 1e-4
