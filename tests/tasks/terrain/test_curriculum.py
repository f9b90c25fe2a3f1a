"""Who goes to a harder tile, who goes back."""

from __future__ import annotations

import numpy as np
import torch

from isaacgymenvs_lite.schema import read_section
from isaacgymenvs_lite.tasks.terrain.grid import (
    Curriculum,
    Terrain,
    TerrainConfig,
    make_terrain,
    next_levels,
)

CPU = torch.device("cpu")


def _curriculum(num_envs: int, **keys) -> tuple[Curriculum, Terrain]:
    cfg = read_section(TerrainConfig, {"numLevels": 3, "numTerrains": 4, **keys}, "terrain")
    terrain = make_terrain(cfg, np.random.default_rng(0))
    return Curriculum(cfg, terrain, num_envs, CPU), terrain


def test_up_beyond_half_a_tile_and_down_below_a_quarter_of_the_command() -> None:
    levels = torch.tensor([1, 1, 1, 1, 0, 2])
    distances = torch.tensor([4.1, 3.9, 2.4, 4.9, 0.0, 5.0])
    # Of commands of 10 m, 0.5 m/s for 20 s, a quarter is 2.5 m; of 20 m it is 5 m.
    commanded = torch.tensor([10.0, 10.0, 10.0, 20.0, 10.0, 10.0])
    moved = next_levels(levels, distances, commanded, 8.0, 3)
    # Up; neither; down; both; not below the first; from the last to the first.
    assert moved.tolist() == [2, 1, 0, 1, 0, 0]


def test_robots_begin_at_the_lowest_levels() -> None:
    assert not _curriculum(100)[0].levels.any()
    assert set(_curriculum(100, maxInitMapLevel=1)[0].levels.tolist()) == {0, 1}
    assert set(_curriculum(100, curriculum=False)[0].levels.tolist()) == {0, 1, 2}
    assert set(_curriculum(100)[0].types.tolist()) == {0, 1, 2, 3}


def test_only_robots_whose_episode_ended_move() -> None:
    curriculum, terrain = _curriculum(4)
    curriculum.levels[:] = 1
    curriculum.types[:] = torch.tensor([0, 1, 2, 3])
    ids = torch.tensor([3, 1])
    origins = curriculum.origins(ids)
    assert torch.allclose(origins.double(), torch.from_numpy(terrain.origins[1, [3, 1]]), atol=1e-6)
    far = origins + torch.tensor([[0.0, 4.5, 9.0], [0.0, 0.0, 0.0]])
    curriculum.update(ids, far, torch.tensor([[0.3, 0.0], [0.3, 0.0]]), 20.0)
    assert curriculum.levels.tolist() == [1, 0, 1, 2]


def test_commands_of_others_count_as_published_only() -> None:
    for published, expected in [(False, 1), (True, 0)]:
        curriculum, _ = _curriculum(9, demotionAsPublished=published)
        curriculum.levels[:] = 1
        ids = torch.arange(9)
        # 2 m are more than a quarter of 0.3 m/s * 20 s, but less than one of 3 * 0.3 m/s * 20 s.
        away = curriculum.origins(ids) + torch.tensor([2.0, 0.0, 0.0])
        curriculum.update(ids, away, torch.tensor([[0.3, 0.0]]).repeat(9, 1), 20.0)
        assert curriculum.levels.tolist() == [expected] * 9
