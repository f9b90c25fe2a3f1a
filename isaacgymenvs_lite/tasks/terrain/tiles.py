"""Square pieces of ground, each kind one pure function.

Height samples are int16, in units of 0.005 m, on a grid of 0.1 m whose first axis is x. The kinds
follow IsaacGymEnvs' AnymalTerrain, remade from their descriptions.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

HORIZONTAL_M = 0.1
"""From one sample to the next."""
VERTICAL_M = 0.005
"""Of one unit of height."""

Samples = npt.NDArray[np.int16]
Size = tuple[int, int]

# Rectangles of `discrete_obstacles` have their corners on every such sample.
_OBSTACLE_GRID = 4
# Between the stones of `stepping_stones`.
_HOLE_DEPTH_M = 10.0


def samples_of(length_m: float) -> int:
    """Return how many samples fit into a length (m), at least one."""
    return max(1, int(round(length_m / HORIZONTAL_M, 6)))


def units_of(height_m: float) -> int:
    """Return a height (m) in whole units, rounded towards zero."""
    # 0.085 / 0.005 is a little less than 17.
    return int(round(height_m / VERTICAL_M, 6))


def pyramid_slope(size: Size, slope: float, platform_m: float) -> Samples:
    """Return a pyramid with a flat top, or for a negative slope a pit with a flat bottom.

    The height is the product of a tent in x and one in y, cut off at the platform's corners.

    Args:
        size: samples in x and y.
        slope: rise over run along the middle of the tile; the edge of the tile is at height 0.
        platform_m: side of the flat square in the middle.
    """
    center = (size[0] // 2, size[1] // 2)
    tent_x, tent_y = (
        1.0 - np.abs(np.arange(n) / c - 1.0) for n, c in zip(size, center, strict=True)
    )
    peak = units_of(slope * size[0] / 2 * HORIZONTAL_M)
    # Rounded, so that a whole number with an error in the last bit stays whole.
    heights = (peak * tent_x[:, None] * tent_y).round(6).astype(np.int16)
    half = samples_of(platform_m) // 2
    corner = heights[center[0] - half, center[1] - half]
    return heights.clip(min(corner, 0), max(corner, 0))


def pyramid_stairs(
    size: Size, step_width_m: float, step_height_m: float, platform_m: float
) -> Samples:
    """Return square rings that rise towards the middle, or sink for a negative step height.

    Args:
        size: samples in x and y.
        step_width_m: of a ring.
        step_height_m: from one ring to the next; the outermost is at height 0.
        platform_m: rings are added while the middle is wider than this.
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
    """Return rectangles of four heights and depths on a plane, with a free square in the middle.

    Args:
        size: samples in x and y.
        rng: draws places, sides and heights.
        max_height_m: the heights are this, half of it, and minus those.
        sides_m: shortest and longest side of a rectangle.
        count: rectangles; later ones replace earlier ones.
        platform_m: side of the free square.
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
    """Return square stones at height 0 in rows along y, between them holes 10 m deep.

    Args:
        size: samples in x and y.
        rng: draws where in each row the first stone ends.
        stone_m: side of a stone.
        gap_m: between stones.
        platform_m: side of a square without holes in the middle.
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
    """Return random heights on a coarse grid, linear in between, to be added to a tile.

    Args:
        size: samples in x and y.
        rng: draws the heights.
        amplitude_m: heights are in +- this.
        step_m: heights are multiples of this.
        spacing_m: of the coarse grid.
    """
    top, step = units_of(amplitude_m), units_of(step_m)
    coarse_size = [max(2, n // samples_of(spacing_m)) for n in size]
    coarse = rng.choice(np.arange(-top, top + 1, step), coarse_size).astype(np.float64)
    along_x = _stretch(coarse, size[0])
    return np.rint(_stretch(along_x.T, size[1]).T).astype(np.int16)


def _stretch(values: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.float64]:
    """Interpolate (n, m) linearly to (count, m); the first and last rows stay."""
    at = np.linspace(0.0, len(values) - 1.0, count)
    below = np.minimum(at.astype(np.int64), len(values) - 2)
    share = (at - below)[:, None]
    return values[below] * (1.0 - share) + values[below + 1] * share


def middle(size: Size, side_m: float) -> tuple[slice, slice]:
    """Return the slices of a square of `side_m` in the middle of a tile."""
    half = samples_of(side_m) // 2
    x, y = size[0] // 2, size[1] // 2
    return slice(x - half, x + half), slice(y - half, y + half)
