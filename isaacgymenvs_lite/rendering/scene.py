"""Pictures of a MuJoCo model in given poses."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from types import TracebackType

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.marks import Arrow, Colour, Mark
from isaacgymenvs_lite.rendering.gl import ensure_gl

Image = npt.NDArray[np.uint8]
"""(height, width, 3), RGB."""

# Half width of the area in which shadows are drawn, in extents of the model: with MuJoCo's 1 the
# shadow map ends in the picture, as noise on the floor.
_SHADOW_CLIP = 4.0
# Texels of the shadow map, samples of a pixel, faces around and along a sphere: the model's 4096
# and MuJoCo's 4, 28 and 16 take most of the time of a picture that is rendered in software.
_FAST_SHADOW_SIZE, _FAST_SAMPLES, _FAST_FACES = 1024, 0, (16, 8)
_ARROW_WIDTH_M = 0.03
# Where a label begins: to the left and up of the middle, in halves of the picture.
_LABEL_PLACE = (0.9, 0.84)


class SceneRenderer:
    """Draws one model; the camera goes along with a free root body. Use it in a `with` statement.

    Args:
        model: the model; it is not changed.
        width: of the pictures, pixels.
        height: pixels.
        azimuth_deg: where the camera looks: 90 along +y, 180 along -x.
        elevation_deg: negative looks down.
        distance_m: from the camera to where it looks.
        look_at_height_m: height of that point above the floor.
        fast: coarser shadows, jagged edges and no reflections, for videos rendered in software.

    Raises:
        RenderingError: no OpenGL library works without a screen.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int,
        height: int,
        *,
        azimuth_deg: float = 90.0,
        elevation_deg: float = -4.0,
        distance_m: float = 2.5,
        look_at_height_m: float = 0.82,
        fast: bool = False,
    ) -> None:
        ensure_gl()
        self._model = model = copy.copy(model)
        self._data = mujoco.MjData(model)
        self._fast = fast
        self._look_at_height_m = look_at_height_m
        self._follows = model.njnt > 0 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
        self._camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, self._camera)
        if self._follows:
            self._camera.azimuth, self._camera.elevation = azimuth_deg, elevation_deg
            self._camera.distance = distance_m
        visual = model.vis
        visual.map.shadowclip = _SHADOW_CLIP
        visual.global_.offwidth, visual.global_.offheight = width, height
        if fast:
            visual.quality.shadowsize = _FAST_SHADOW_SIZE
            visual.quality.offsamples = _FAST_SAMPLES
            visual.quality.numslices, visual.quality.numstacks = _FAST_FACES
        self._renderer = mujoco.Renderer(model, height, width)

    def draw(self, qpos: npt.ArrayLike, label: str = "", marks: Sequence[Mark] = ()) -> Image:
        """Return a picture of the model at joint positions `qpos` (nq,).

        Args:
            qpos: in MuJoCo's order and units, quaternions wxyz.
            label: text in the upper left corner.
            marks: what else to draw.
        """
        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)
        if self._follows:
            self._camera.lookat[:] = (*self._data.qpos[:2], self._look_at_height_m)
        self._renderer.update_scene(self._data, self._camera)
        if self._fast:
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        for mark in marks:
            self._add_mark(mark)
        if label:
            self._add_label(label)
        return self._renderer.render()

    def _add_mark(self, mark: Mark) -> None:
        if isinstance(mark, Arrow):
            geom = self._add_geom(mujoco.mjtGeom.mjGEOM_ARROW, colour=mark.colour)
            ends = (np.array(mark.start_w), np.array(mark.end_w))
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, _ARROW_WIDTH_M, *ends)
        else:
            size = np.full(3, mark.radius_m)
            self._add_geom(mujoco.mjtGeom.mjGEOM_SPHERE, size, np.array(mark.centre_w), mark.colour)

    def _add_geom(
        self,
        kind: int,
        size: npt.NDArray[np.float64] | None = None,
        place_w: npt.NDArray[np.float64] | None = None,
        colour: Colour = (1.0, 1.0, 1.0),
    ) -> mujoco.MjvGeom:
        """Add a shape to the scene that is drawn next."""
        scene = self._renderer.scene
        geom = scene.geoms[scene.ngeom]
        size = np.zeros(3) if size is None else size
        place_w = np.zeros(3) if place_w is None else place_w
        ink = np.array((*colour, 1.0), dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, size, place_w, np.eye(3).ravel(), ink)
        scene.ngeom += 1
        return geom

    def _add_label(self, text: str) -> None:
        camera = self._camera
        azimuth = np.deg2rad(camera.azimuth)
        to_the_right = np.array((np.sin(azimuth), -np.cos(azimuth), 0.0))
        half_height_m = camera.distance * np.tan(np.deg2rad(self._model.vis.global_.fovy / 2))
        half_width_m = half_height_m * self._renderer.width / self._renderer.height
        corner = camera.lookat - _LABEL_PLACE[0] * half_width_m * to_the_right
        corner[2] += _LABEL_PLACE[1] * half_height_m
        self._add_geom(mujoco.mjtGeom.mjGEOM_LABEL, place_w=corner).label = text

    def close(self) -> None:
        """Free the renderer; a second call does nothing."""
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
