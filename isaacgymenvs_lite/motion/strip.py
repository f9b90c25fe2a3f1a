"""Renders a clip as a strip of frames: python -m isaacgymenvs_lite.motion.strip CLIP OUT.png.

The MuJoCo renderer needs an OpenGL library that works without a screen: MUJOCO_GL=egl or osmesa.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError, UserError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.qpos import qpos_from_poses
from isaacgymenvs_lite.motion.skeleton import Skeleton

_MODEL = "mjcf/amp_humanoid.xml"
_CAMERA_DISTANCE_M = 2.5
_CAMERA_HEIGHT_M = 0.82
_FRAME_WIDTH, _FRAME_HEIGHT = 200, 320
# Half width of the area in which shadows are drawn, in extents of the model: with MuJoCo's 1 the
# shadow map ends in the picture, as noise on the floor.
_SHADOW_CLIP = 4.0


def render_frames(
    clip: MotionClip, times_s: FloatArray, azimuth_deg: float = 90.0
) -> list[npt.NDArray[np.uint8]]:
    """Render the poses nearest to `times_s` from the side, the camera moving along.

    Args:
        clip: a clip of the shipped humanoid.
        times_s: times within the clip.
        azimuth_deg: where the camera looks: 90 from the right side, 180 from the front.

    Returns:
        One image (height, width, 3) per time.
    """
    path = str(paths.assets_dir() / _MODEL)
    skeleton = Skeleton.from_mjcf(path)
    model = mujoco.MjModel.from_xml_path(path)
    model.vis.map.shadowclip = _SHADOW_CLIP
    data = mujoco.MjData(model)
    poses = qpos_from_poses(skeleton, clip.root_translation, clip.local_rotation)
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.distance, camera.azimuth, camera.elevation = _CAMERA_DISTANCE_M, azimuth_deg, -4.0
    images = []
    with mujoco.Renderer(model, _FRAME_HEIGHT, _FRAME_WIDTH) as renderer:
        for time_s in times_s:
            frame = int(np.clip(round(time_s * clip.fps), 0, clip.num_frames - 1))
            data.qpos[:] = poses[frame]
            mujoco.mj_forward(model, data)
            camera.lookat[:] = (*data.qpos[:2], _CAMERA_HEIGHT_M)
            renderer.update_scene(data, camera)
            images.append(renderer.render().copy())
    return images


def save_strip(
    clip: MotionClip,
    path: str | Path,
    span_s: float,
    num_frames: int = 8,
    azimuth_deg: float = 90.0,
) -> Path:
    """Write a PNG with `num_frames` poses, evenly spaced over the first `span_s`, side by side.

    Raises:
        ConfigError: Pillow is not installed.
    """
    image = _import_pillow()
    times_s = np.arange(num_frames) * (span_s / num_frames)
    strip = np.concatenate(render_frames(clip, times_s, azimuth_deg), axis=1)
    path = Path(path)
    image.fromarray(strip).quantize(128).save(path, optimize=True)
    return path


def _import_pillow() -> Any:
    if importlib.util.find_spec("PIL") is None:
        raise ConfigError(
            "writing pictures needs the package Pillow, which is not installed; "
            'pip install "isaacgymenvs-lite[docs]"'
        )
    return importlib.import_module("PIL.Image")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m isaacgymenvs_lite.motion.strip",
        description="Renders poses of a motion clip side by side; needs MUJOCO_GL=egl or osmesa.",
    )
    parser.add_argument("clip", help="a motion file, or the name of one in assets/amp/motions")
    parser.add_argument("out", type=Path, help="the PNG to write")
    parser.add_argument("--seconds", type=float, help="the time to show (default: the whole clip)")
    parser.add_argument("--frames", type=int, default=8, help="the number of poses (default: 8)")
    parser.add_argument(
        "--azimuth",
        type=float,
        default=90.0,
        help="90 from the right (default), 180 from the front",
    )
    options = parser.parse_args(arguments)
    try:
        clip = load_clips(options.clip)[0][0]
        seconds = options.seconds or clip.length_s
        save_strip(clip, options.out, seconds, options.frames, options.azimuth)
    except UserError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
