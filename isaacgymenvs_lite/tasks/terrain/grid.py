"""The ground of AnymalTerrain, a grid of increasingly hard tiles in a flat border.

The tile of level 0 and type 0 has a corner at the world origin. The level of a tile increases along
x, and its type along y. As in IsaacGymEnvs, a pure function makes each kind of tile. Height samples
are int16 in units of 0.005 m, on a grid of 0.1 m whose first axis is x.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.task_config import PlaneConfig
from isaacgymenvs_lite.utils.state import Stateful

HORIZONTAL_M = 0.1
"""Distance of neighbouring samples."""
VERTICAL_M = 0.005
"""Unit of the height samples."""

Samples = npt.NDArray[np.int16]
Size = tuple[int, int]

_OBSTACLE_GRID = 4  # positions and sides of obstacles vary by this number of samples
_HOLE_DEPTH_M = 10.0
_PLATFORM_M = 3.0
_STEP_WIDTH_M = 0.31
_OBSTACLE_SIDES_M = (1.0, 2.0)
_NUM_OBSTACLES = 40
_NOISE_M = 0.1
_NOISE_SPACING_M = 0.2
_START_AREA_M = 2.0  # square in the middle of a tile
_DEMOTED_SHARE = 0.25
_GROUND_M = 1.0  # a thick ground stops fast bodies


def samples_of(length_m: float) -> int:
    """Return the number of height samples along a length (m), at least 1."""
    return max(1, int(round(length_m / HORIZONTAL_M, 6)))


def units_of(height_m: float) -> int:
    """Return a height (m) in whole units, rounded towards zero."""
    # Rounding is necessary, because 0.085 / 0.005 is less than 17 in floating point.
    return int(round(height_m / VERTICAL_M, 6))


def pyramid_slope(size: Size, slope: float, platform_m: float) -> Samples:
    """Return a pyramid with a flat top, or a pit with a flat bottom if the slope is negative.

    The height is a triangle function of x times one of y, limited to the height at the corners of
    the platform. The edge of the tile has the height 0. `slope` is the rise over run along the
    middle lines of the tile. `platform_m` is the side of the flat square.
    """
    center = (size[0] // 2, size[1] // 2)
    tent_x, tent_y = (
        1.0 - np.abs(np.arange(n) / c - 1.0) for n, c in zip(size, center, strict=True)
    )
    peak = units_of(slope * size[0] / 2 * HORIZONTAL_M)
    # Rounding removes floating-point errors before truncation.
    heights = (peak * tent_x[:, None] * tent_y).round(6).astype(np.int16)
    half = samples_of(platform_m) // 2
    corner = heights[center[0] - half, center[1] - half]
    return heights.clip(min(corner, 0), max(corner, 0))


def pyramid_stairs(
    size: Size, step_width_m: float, step_height_m: float, platform_m: float
) -> Samples:
    """Return square steps that rise towards the middle, or sink if the step height is negative.

    The outermost step has height 0. Steps are added while the middle is wider than `platform_m`.
    """
    width, platform = samples_of(step_width_m), samples_of(platform_m)
    rise = units_of(step_height_m)
    heights = np.zeros(size, dtype=np.int16)
    inset = 0
    while min(size) - 2 * inset > platform:
        inset += width
        heights[inset : size[0] - inset, inset : size[1] - inset] += rise
    return heights


def discrete_obstacles(
    size: Size,
    rng: np.random.Generator,
    max_height_m: float,
    sides_m: tuple[float, float],
    count: int,
    platform_m: float,
) -> Samples:
    """Return `count` rectangles on a plane, with a free square of side `platform_m` in the middle.

    The heights are +-`max_height_m` and +-`max_height_m` / 2. `sides_m` are the shortest and the
    longest side of a rectangle. Later rectangles overwrite earlier ones.
    """
    top = units_of(max_height_m)
    choices = (-top, -(top // 2), top // 2, top)
    sides = np.arange(samples_of(sides_m[0]), samples_of(sides_m[1]), _OBSTACLE_GRID)
    heights = np.zeros(size, dtype=np.int16)
    for _ in range(count):
        length_x, length_y = rng.choice(sides, 2)
        x = rng.choice(np.arange(0, size[0] - length_x, _OBSTACLE_GRID))
        y = rng.choice(np.arange(0, size[1] - length_y, _OBSTACLE_GRID))
        heights[x : x + length_x, y : y + length_y] = rng.choice(choices)
    heights[middle(size, platform_m)] = 0
    return heights


def stepping_stones(
    size: Size, rng: np.random.Generator, stone_m: float, gap_m: float, platform_m: float
) -> Samples:
    """Return rows of square stones along y, with height 0 and with holes of 10 m between them.

    `rng` draws where the first stone of each row ends. The square in the middle of the tile has no
    holes.
    """
    stone, gap = samples_of(stone_m), samples_of(gap_m)
    period = stone + gap
    in_row = np.arange(size[0]) % period < stone
    firsts = rng.integers(0, period, size[0] // period + 1)
    along = np.arange(size[1]) + firsts[np.arange(size[0]) // period, None]
    solid = in_row[:, None] & (along % period < stone)
    solid[middle(size, platform_m)] = True
    return np.where(solid, 0, -units_of(_HOLE_DEPTH_M)).astype(np.int16)


def roughness(
    size: Size, rng: np.random.Generator, amplitude_m: float, step_m: float, spacing_m: float
) -> Samples:
    """Return linearly interpolated random heights of a coarse grid, which can be added to a tile.

    The heights are multiples of `step_m` between -`amplitude_m` and `amplitude_m`.
    """
    top, step = units_of(amplitude_m), units_of(step_m)
    coarse_size = [max(2, n // samples_of(spacing_m)) for n in size]
    coarse = rng.choice(np.arange(-top, top + 1, step), coarse_size).astype(np.float64)
    along_x = _stretch(coarse, size[0])
    return np.rint(_stretch(along_x.T, size[1]).T).astype(np.int16)


def _stretch(values: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.float64]:
    """Interpolate the rows (n, m) linearly to (count, m). The first and last rows are kept."""
    at = np.linspace(0.0, len(values) - 1.0, count)
    below = np.minimum(at.astype(np.int64), len(values) - 2)
    share = (at - below)[:, None]
    return values[below] * (1.0 - share) + values[below + 1] * share


def middle(size: Size, side_m: float) -> tuple[slice, slice]:
    """Return the slices of a square of side `side_m` in the middle of a tile."""
    half = samples_of(side_m) // 2
    x, y = size[0] // 2, size[1] // 2
    return slice(x - half, x + half), slice(y - half, y + half)


@dataclass(frozen=True, kw_only=True)
class TerrainConfig(PlaneConfig):
    """`task.env.terrain`."""

    terrain_type: str = setting("trimesh", key="terrainType", choices=("trimesh", "plane"))
    curriculum: bool = setting(True)
    max_init_level: int = setting(0, key="maxInitMapLevel", minimum=0)
    length_m: float = setting(8.0, key="mapLength", minimum=4, maximum=100)
    width_m: float = setting(8.0, key="mapWidth", minimum=4, maximum=100)
    num_levels: int = setting(10, key="numLevels", minimum=1)
    num_types: int = setting(20, key="numTerrains", minimum=1)
    proportions: tuple[float, ...] = setting(
        (0.1, 0.1, 0.35, 0.25, 0.2), key="terrainProportions", minimum=0, min_length=5
    )
    """Shares of smooth slopes, rough slopes, stairs down, stairs up and obstacles among the tiles.
    All other tiles are stepping stones."""
    slope_threshold: float = setting(0.5, key="slopeTreshold", minimum=0)  # no effect
    border_m: float = setting(20.0, key="borderSize", minimum=0)
    demotion_as_published: bool = setting(False, key="demotionAsPublished")


@dataclass(frozen=True)
class Terrain:
    """Ground of X x Y height samples, with tiles of L levels and T types."""

    samples: Samples
    """(X, Y) heights in units of 0.005 m."""
    origins: npt.NDArray[np.float64]
    """(L, T, 3) start positions (m) in the middles of tiles, at the largest height nearby."""
    border_m: float
    """Width of the border (m). The first sample is at (-border_m, -border_m)."""


def make_terrain(cfg: TerrainConfig, rng: np.random.Generator) -> Terrain:
    """Return the ground of a configuration, whose random tiles `rng` draws.

    Raises:
        ConfigError: `maxInitMapLevel` is not below `numLevels`.
    """
    if cfg.terrain_type == "plane":
        return Terrain(np.zeros((2, 2), dtype=np.int16), np.zeros((1, 1, 3)), 0.0)
    if cfg.max_init_level >= cfg.num_levels:
        raise ConfigError(
            f"task.env.terrain.maxInitMapLevel={cfg.max_init_level}: expected a level below"
            f" numLevels={cfg.num_levels}"
        )
    size = samples_of(cfg.length_m), samples_of(cfg.width_m)
    border = samples_of(cfg.border_m) if cfg.border_m > 0 else 0
    inner = cfg.num_levels * size[0], cfg.num_types * size[1]
    samples = np.zeros((inner[0] + 2 * border, inner[1] + 2 * border), dtype=np.int16)
    origins = np.zeros((cfg.num_levels, cfg.num_types, 3))
    for level in range(cfg.num_levels):
        for kind in range(cfg.num_types):
            if cfg.curriculum:
                tile = _graded_tile(cfg, size, rng, level / cfg.num_levels, kind / cfg.num_types)
            else:
                tile = _random_tile(size, rng)
            x, y = border + level * size[0], border + kind * size[1]
            samples[x : x + size[0], y : y + size[1]] = tile
            top = int(tile[middle(size, _START_AREA_M)].max())
            origins[level, kind] = (
                (level + 0.5) * cfg.length_m,
                (kind + 0.5) * cfg.width_m,
                top * VERTICAL_M,
            )
    return Terrain(samples, origins, border * HORIZONTAL_M)


def _graded_tile(
    cfg: TerrainConfig, size: Size, rng: np.random.Generator, difficulty: float, choice: float
) -> Samples:
    """Return a tile of this difficulty in [0, 1). `choice` in [0, 1) selects the tile type."""
    # Rounding is necessary, because 0.1 + 0.1 + 0.35 exceeds 0.55 in floating point.
    ends = np.cumsum(cfg.proportions).round(9)
    step_m = 0.05 + 0.175 * difficulty
    if choice < ends[1]:
        # A type's first half of the columns are pits, and the second half are pyramids.
        rough = choice >= ends[0]
        half = round((ends[0] + ends[1]) / 2 if rough else ends[0] / 2, 9)
        slope = 0.4 * difficulty
        tile = pyramid_slope(size, -slope if choice < half else slope, _PLATFORM_M)
        return tile + roughness(size, rng, _NOISE_M, 0.025, _NOISE_SPACING_M) if rough else tile
    if choice < ends[3]:
        rise_m = -step_m if choice < ends[2] else step_m
        return pyramid_stairs(size, _STEP_WIDTH_M, rise_m, _PLATFORM_M)
    if choice < ends[4]:
        return _obstacles(size, rng, 0.025 + 0.15 * difficulty)
    return stepping_stones(size, rng, 2.0 - 1.8 * difficulty, 0.1, _PLATFORM_M)


def _random_tile(size: Size, rng: np.random.Generator) -> Samples:
    """Return a random tile for a ground without curriculum."""
    choice = rng.random()
    if choice < 0.1:
        tile = pyramid_slope(size, rng.choice((-0.3, -0.2, 0.0, 0.2, 0.3)), _PLATFORM_M)
        if rng.random() < 0.5:
            tile = tile + roughness(size, rng, _NOISE_M, 0.05, _NOISE_SPACING_M)
        return tile
    if choice < 0.6:
        return pyramid_stairs(size, _STEP_WIDTH_M, rng.choice((-0.15, 0.15)), _PLATFORM_M)
    return _obstacles(size, rng, 0.15)


def _obstacles(size: Size, rng: np.random.Generator, max_height_m: float) -> Samples:
    return discrete_obstacles(
        size, rng, max_height_m, _OBSTACLE_SIDES_M, _NUM_OBSTACLES, _PLATFORM_M
    )


def add_height_field(spec: mujoco.MjSpec, terrain: Terrain) -> None:
    """Replace the geom `floor` by a height field, which all environments share."""
    heights = terrain.samples * VERTICAL_M
    lowest, highest = float(heights.min()), float(heights.max())
    # In MuJoCo, rows of samples are ordered along y, and samples are shares of the elevation.
    num_x, num_y = heights.shape
    half_x, half_y = (num_x - 1) * HORIZONTAL_M / 2, (num_y - 1) * HORIZONTAL_M / 2
    spec.add_hfield(
        name="terrain",
        nrow=num_y,
        ncol=num_x,
        size=(half_x, half_y, max(highest - lowest, VERTICAL_M), _GROUND_M),
        userdata=(heights - lowest).T.ravel(),
    )
    floor = spec.geom("floor")
    floor.type = mujoco.mjtGeom.mjGEOM_HFIELD
    floor.hfieldname = "terrain"
    floor.size = (0.0, 0.0, 0.0)
    floor.pos = (half_x - terrain.border_m, half_y - terrain.border_m, lowest)


def next_levels(
    levels: Tensor,
    distances_m: Tensor,
    commanded_m: Tensor,
    tile_length_m: float,
    num_levels: int,
) -> Tensor:
    """Return the levels (n,) after an episode, as in IsaacGymEnvs.

    A robot that went farther than half a tile goes one level up. A robot that covered less than a
    quarter of the commanded distance goes one level down. A robot to which both apply keeps its
    level. Level 0 is the lowest, and level 0 follows the last level.

    `distances_m` (n,) are the horizontal distances from the middle of the tile. `commanded_m` (n,)
    are the commanded speeds times the episode length.
    """
    up = (distances_m > tile_length_m / 2.0).long()
    down = (distances_m < _DEMOTED_SHARE * commanded_m).long()
    return (levels + up - down).clamp(min=0) % num_levels


class Curriculum(Stateful):
    """Levels and types (N,) int64 of the tiles of N robots.

    With `demotionAsPublished`, the distance of each robot is compared with the norm of the commands
    of all robots that start at the same time. This is an error in IsaacGymEnvs, by which more
    robots go back a level.
    """

    stored = ("levels", "types")

    def __init__(
        self, cfg: TerrainConfig, terrain: Terrain, num_envs: int, device: torch.device
    ) -> None:
        self._cfg = cfg
        self._origins = torch.from_numpy(terrain.origins).float().to(device)
        num_levels, num_types = self._origins.shape[:2]
        # Without a curriculum, all levels are equally hard.
        highest = cfg.max_init_level if cfg.curriculum else num_levels - 1
        highest = min(highest, num_levels - 1)
        self.levels = torch.randint(highest + 1, (num_envs,), device=device)
        self.types = torch.randint(num_types, (num_envs,), device=device)

    def origins(self, env_ids: Tensor) -> Tensor:
        """Return the middles (n, 3) m of the tiles of environments (n,)."""
        return self._origins[self.levels[env_ids], self.types[env_ids]]

    def update(
        self, env_ids: Tensor, root_pos: Tensor, command: Tensor, episode_length_s: float
    ) -> None:
        """Move robots (n,) whose episode ended to their next level.

        `root_pos` (n, 3) is in m, `command` (n, 2) is the commanded velocity (m/s), and
        `episode_length_s` is the duration of the longest episode.
        """
        if not self._cfg.curriculum or len(env_ids) == 0:
            return
        distances = (root_pos - self.origins(env_ids))[:, :2].norm(dim=-1)
        speeds = command.norm(dim=None if self._cfg.demotion_as_published else -1)
        levels = next_levels(
            self.levels[env_ids],
            distances,
            speeds * episode_length_s,
            self._cfg.length_m,
            len(self._origins),
        )
        self.levels.index_copy_(0, env_ids, levels)
