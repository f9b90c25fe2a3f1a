"""Renders a clip as a strip of frames: python -m isaacgymenvs_lite.motion.strip CLIP OUT.png.

Needs an OpenGL library that works without a screen, EGL or OSMesa; see `rendering`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError, UserError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.loader import load_single_clip
from isaacgymenvs_lite.motion.qpos import clip_to_qpos
from isaacgymenvs_lite.rendering.scene import Image, SceneRenderer
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.utils.optional_packages import import_package, require

_FRAME_WIDTH, _FRAME_HEIGHT = 200, 320
_NUM_COLOURS = 128


def draw_poses(
    model: mujoco.MjModel, qpos: npt.NDArray[np.float64], azimuth_deg: float = 90.0
) -> Image:
    """Draw poses (n, nq) side by side, each from a camera of its own.

    Args:
        model: of the figure.
        qpos: joint positions in MuJoCo's order.
        azimuth_deg: where the camera looks: 90 from the right side, 180 from the front.

    Returns:
        A picture (height, n * width, 3).

    Raises:
        RenderingError: this machine cannot draw.
    """
    view = View(azimuth_deg=azimuth_deg)
    with SceneRenderer(model, _FRAME_WIDTH, _FRAME_HEIGHT, view=view) as renderer:
        return np.concatenate([renderer.draw(pose) for pose in qpos], axis=1)


def save_strip(
    clip: MotionClip,
    path: str | Path,
    span_s: float,
    num_frames: int = 8,
    azimuth_deg: float = 90.0,
) -> Path:
    """Write a PNG with `num_frames` poses, evenly spaced over the first `span_s`, side by side.

    Args:
        clip: a clip of a shipped humanoid, see `clip_to_qpos`.
        path: the file.
        span_s: time to show; the poses are those nearest in the clip.
        num_frames: number of poses.
        azimuth_deg: see `draw_poses`.

    Raises:
        MissingPackageError: Pillow is not installed.
        RenderingError: this machine cannot draw.
    """
    require("PIL", "writing pictures")  # before the drawing
    model, poses = clip_to_qpos(clip)
    times_s = np.arange(num_frames) * (span_s / num_frames)
    frames = np.round(times_s * clip.fps).astype(int).clip(0, clip.num_frames - 1)
    return save_png(path, draw_poses(model, poses[frames], azimuth_deg))


def save_png(path: str | Path, image: Image) -> Path:
    """Write a picture (height, width, 3) with few colours, for a small file.

    Raises:
        MissingPackageError: Pillow is not installed.
        ConfigError: the file cannot be written.
    """
    pillow = import_package("PIL.Image", "writing pictures")
    path = Path(path)
    try:
        pillow.fromarray(image).quantize(_NUM_COLOURS).save(path, format="PNG", optimize=True)
    except OSError as error:
        raise ConfigError(f"cannot write the picture {path.absolute()} ({error})") from error
    return path


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m isaacgymenvs_lite.motion.strip",
        description="Renders poses of a motion clip side by side.",
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
        clip, _ = load_single_clip(options.clip)
        seconds = options.seconds or clip.length_s
        save_strip(clip, options.out, seconds, options.frames, options.azimuth)
    except UserError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
