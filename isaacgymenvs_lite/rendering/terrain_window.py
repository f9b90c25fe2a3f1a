"""Terrain for pictures: draws only the piece around a robot, and gives the height of the ground.

A terrain of a hundred metres has more than a million cells: drawing it in software takes about a
second.
"""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

# Half the side of the piece that is drawn, and how far a robot may go before it is replaced.
_HALF_SIDE_M = 14.0
_STEP_M = 4.0
# Half the side of the square whose mean height is "the ground" at a place.
_GROUND_HALF_SIDE_M = 1.0


class TerrainWindow:
    """The piece of a model's height field around a place.

    Args:
        model: changed by `move`: its height field becomes a smaller one. Models without a height
            field are left alone.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._centre_xy: npt.NDArray[np.float64] | None = None
        if model.nhfield == 0:
            return
        rows, columns = int(model.hfield_nrow[0]), int(model.hfield_ncol[0])
        self._heights = model.hfield_data[: rows * columns].reshape(rows, columns).copy()
        self._size = model.hfield_size[0].copy()
        (geoms,) = np.nonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_HFIELD))
        self._geom = int(geoms[0])
        self._place = model.geom_pos[self._geom].copy()
        # MuJoCo would not move a geom that has its body's frame.
        model.geom_sameframe[self._geom] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        # m from one number to the next, along x and y
        self._cell = 2.0 * self._size[:2] / (np.array((columns, rows)) - 1)

    def height(self, xy: npt.NDArray[np.float64]) -> float:
        """Return the mean height (m) of the ground about `xy` (2,); 0 without a height field."""
        if self._model.nhfield == 0:
            return 0.0
        (x0, x1), (y0, y1) = self._range(xy, _GROUND_HALF_SIDE_M)
        return float(self._place[2] + self._size[2] * self._heights[y0:y1, x0:x1].mean())

    def move(self, xy: npt.NDArray[np.float64]) -> bool:
        """Make the piece around `xy` (2,) the model's height field; return whether it changed."""
        if self._model.nhfield == 0:
            return False
        if self._centre_xy is not None and np.abs(xy - self._centre_xy).max() < _STEP_M:
            return False
        self._centre_xy = np.array(xy, dtype=np.float64)
        (x0, x1), (y0, y1) = self._range(xy, _HALF_SIDE_M)
        piece, model = self._heights[y0:y1, x0:x1], self._model
        model.hfield_nrow[0], model.hfield_ncol[0] = piece.shape
        model.hfield_data[: piece.size] = piece.ravel()
        half_cells = 0.5 * np.array((x1 - x0 - 1, y1 - y0 - 1))
        model.hfield_size[0, :2] = half_cells * self._cell
        first = self._place[:2] - self._size[:2] + np.array((x0, y0)) * self._cell
        model.geom_pos[self._geom, :2] = first + half_cells * self._cell
        return True

    def _range(
        self, xy: npt.NDArray[np.float64], half_side_m: float
    ) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return the columns and the rows (first, end) within `half_side_m` of `xy`."""
        at = (np.asarray(xy) - self._place[:2] + self._size[:2]) / self._cell
        reach = half_side_m / self._cell
        ends = np.array(self._heights.shape[::-1])
        # At least two cells, also for a robot that left the terrain.
        low = np.clip(np.floor(at - reach), 0, ends - 2).astype(int)
        high = np.clip(np.ceil(at + reach) + 1, low + 2, ends).astype(int)
        return (int(low[0]), int(high[0])), (int(low[1]), int(high[1]))
