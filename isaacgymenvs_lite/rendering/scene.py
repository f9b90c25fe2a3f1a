"""Draws pictures of a MuJoCo model in given poses."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.rendering.markers import Marker, add_geom, add_markers
from isaacgymenvs_lite.rendering.view import View, has_free_root

# Half the side of the drawn piece of terrain. When the camera has moved by the second distance, the
# piece is replaced.
_HALF_SIDE_M = 14.0
_STEP_M = 4.0
# Half the side of the square over which the height of the ground is averaged.
_GROUND_HALF_SIDE_M = 1.0


class TerrainWindow:
    """A square piece of a model's height field around a position.

    `move` replaces the model's height field by the piece. A model without a height field does not
    change.
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
        # MuJoCo does not move a geom that shares its body's frame.
        model.geom_sameframe[self._geom] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        # Distances (m) between neighbouring points of the height field along x and y.
        self._cell = 2.0 * self._size[:2] / (np.array((columns, rows)) - 1)

    def height(self, xy: npt.NDArray[np.float64]) -> float:
        """Return the mean height (m) of the ground around `xy` (2,), or 0 on a plane."""
        if self._model.nhfield == 0:
            return 0.0
        (x0, x1), (y0, y1) = self._range(xy, _GROUND_HALF_SIDE_M)
        return float(self._place[2] + self._size[2] * self._heights[y0:y1, x0:x1].mean())

    def move(self, xy: npt.NDArray[np.float64]) -> bool:
        """Move the drawn piece to `xy` (2,); return whether the height field changed."""
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
        """Return the ranges (first, end) of columns and rows within `half_side_m` of `xy`."""
        at = (np.asarray(xy) - self._place[:2] + self._size[:2]) / self._cell
        reach = half_side_m / self._cell
        ends = np.array(self._heights.shape[::-1])
        # If the robot has left the terrain, the ranges still contain two cells.
        low = np.clip(np.floor(at - reach), 0, ends - 2).astype(int)
        high = np.clip(np.ceil(at + reach) + 1, low + 2, ends).astype(int)
        return (int(low[0]), int(high[0])), (int(low[1]), int(high[1]))


Image = npt.NDArray[np.uint8]
"""(height, width, 3), RGB."""
Track = npt.NDArray[np.float64]
"""(T, nq), MuJoCo's qpos of one robot at T times."""

# Largest size of a model as a multiple of the camera's distance. MuJoCo derives the clipping planes
# from the model's size; with the size of a terrain they would clip the robot.
_MAX_EXTENT = 0.7
# Half the width of the area with shadows, as a multiple of the camera's distance. With MuJoCo's
# default, the size of the model, the border of the area is visible as noise on the floor.
_SHADOW_HALF_WIDTH = 4.2
# Height of the light above the camera's target, as a multiple of the camera's distance.
_LIGHT_ABOVE = 0.45
# In this order: texels along the shadow map, samples per pixel, faces around a sphere, faces along
# a sphere. Software rendering would spend most of its time on the default values (4096, 4, 28, 16).
_FAST_SHADOW_SIZE, _FAST_SAMPLES, _FAST_FACES = 1024, 0, (16, 8)
_FLOOR_STEP_M = 10.0
# Distances in pixels of a label's left edge from the left and of its base line from the top. They
# are constant, because the letters have the same size in all pictures.
_LABEL_LEFT, _LABEL_BASE = 10, 26


class SceneRenderer:
    """Draws one model, which does not change; the camera follows a free root body.

    Use this class in a `with` statement. By default, a model that is fixed to the world is
    completely visible. `fast` leaves out smooth edges and reflections, for videos that are rendered
    in software.

    Raises:
        RenderingError: no OpenGL library works without a screen.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int,
        height: int,
        *,
        view: View | None = None,
        fast: bool = False,
    ) -> None:
        ensure_gl()
        self._model = model = copy.copy(model)
        self._data = mujoco.MjData(model)
        self._fast = fast
        if view is None:
            view = View() if has_free_root(model) else View.of_model(model)
        self._view = view
        self._ground = TerrainWindow(model)
        self._ground.move(np.zeros(2))  # A piece of the terrain is faster than the whole terrain.
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation = view.azimuth_deg, view.elevation_deg
        self._camera.distance = view.distance_m
        model.stat.extent = min(model.stat.extent, _MAX_EXTENT * view.distance_m)
        visual = model.vis
        visual.map.shadowclip = _SHADOW_HALF_WIDTH * view.distance_m / model.stat.extent
        visual.global_.offwidth, visual.global_.offheight = width, height
        if fast:
            visual.quality.shadowsize = _FAST_SHADOW_SIZE
            visual.quality.offsamples = _FAST_SAMPLES
            visual.quality.numslices, visual.quality.numstacks = _FAST_FACES
        self._renderer = mujoco.Renderer(model, height, width)
        self._floor_at = np.full(3, np.inf)

    def draw(
        self,
        qpos: npt.ArrayLike,
        label: str = "",
        markers: Sequence[Marker] = (),
        look_at: npt.ArrayLike | None = None,
    ) -> Image:
        """Return a picture of the model in the pose `qpos` (nq,), with a label and markers.

        The camera looks at the root of the pose `look_at`, which is `qpos` by default.
        """
        self._data.qpos[:] = qpos
        self._aim(np.asarray(qpos if look_at is None else look_at)[:3])
        # A picture needs body poses, but not the other results of mj_forward.
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        # The light must be above the camera's target, because the shadow map is centred at the
        # light. The light is low, because a high light makes speckles on the distant floor.
        self._data.light_xpos[:, :2] += self._camera.lookat[:2]
        self._data.light_xpos[:, 2] = self._camera.lookat[2] + _LIGHT_ABOVE * self._camera.distance
        mujoco.mj_tendon(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        if np.linalg.norm(self._camera.lookat - self._floor_at) > _FLOOR_STEP_M:
            # MuJoCo centres an infinite floor at the camera's previous position.
            self._floor_at = self._camera.lookat.copy()
            self._renderer.update_scene(self._data, self._camera)
        if self._fast:
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        add_markers(self._renderer.scene, markers)
        if label:
            self._add_label(label)
        return self._renderer.render()

    def _aim(self, root: npt.NDArray[np.float64]) -> None:
        """Point the camera at a root position (3,) m; move the drawn piece of terrain below it."""
        view, lookat = self._view, self._camera.lookat
        if not view.moves_about:
            lookat[:] = (*view.centre_xy_m, view.look_at_height_m)
            return
        if self._ground.move(root[:2]):
            self._upload_ground()
        below = root[2] if view.flies else self._ground.height(root[:2])
        lookat[:] = (*root[:2], below + view.look_at_height_m)

    def _upload_ground(self) -> None:
        # MuJoCo's Renderer has no public method that uploads a height field.
        renderer: Any = self._renderer
        renderer._gl_context.make_current()
        mujoco.mjr_uploadHField(self._model, renderer._mjr_context, 0)

    def _add_label(self, text: str) -> None:
        """Add a label in the upper left corner, in the plane through the camera's target."""
        camera = self._camera
        azimuth, elevation = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
        to_the_right = np.array((np.sin(azimuth), -np.cos(azimuth), 0.0))
        ahead = np.array((np.cos(azimuth), np.sin(azimuth), 0.0))
        up = np.cos(elevation) * np.array((0.0, 0.0, 1.0)) - np.sin(elevation) * ahead
        half_height_m = camera.distance * np.tan(np.deg2rad(self._model.vis.global_.fovy / 2))
        pixel_m = 2.0 * half_height_m / self._renderer.height
        corner = camera.lookat + (self._renderer.height / 2 - _LABEL_BASE) * pixel_m * up
        corner -= (self._renderer.width / 2 - _LABEL_LEFT) * pixel_m * to_the_right
        add_geom(self._renderer.scene, mujoco.mjtGeom.mjGEOM_LABEL, place_w=corner).label = text

    def close(self) -> None:
        """Release the renderer; a second call does nothing."""
        self._renderer.close()

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
