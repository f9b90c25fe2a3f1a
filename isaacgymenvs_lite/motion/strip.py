"""Renders a clip as a strip of frames: isaacgymenvs-lite strip CLIP OUT.png.

    isaacgymenvs-lite strip walk walk.png seconds=0.9 frames=8 azimuth=180
    isaacgymenvs-lite strip g1_walk walk.png robot=mjcf/g1.xml

CLIP is a motion file of any format, or the name of a shipped clip. A clip of a robot needs the
robot's file, robot=FILE. The strip shows the first `seconds` (default: the whole clip) in `frames`
poses (default: 8), from the right (azimuth=90). The command needs EGL or OSMesa, which render
without a screen.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.qpos import clip_to_qpos
from isaacgymenvs_lite.motion.robot_file import load_shown_clip, run_file_command, view_of
from isaacgymenvs_lite.rendering.scene import Image, SceneRenderer
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.schema import setting

_FRAME_WIDTH, _FRAME_HEIGHT = 200, 320
ASPECT = _FRAME_WIDTH / _FRAME_HEIGHT
"""Width divided by height of the picture of one pose."""
_NUM_COLOURS = 128


def draw_poses(
    model: mujoco.MjModel, qpos: npt.NDArray[np.float64], view: View | None = None
) -> Image:
    """Draw poses (n, nq) side by side in a picture (height, n * width, 3).

    Each pose has a separate camera. The default view shows a humanoid from the right.
    """
    with SceneRenderer(model, _FRAME_WIDTH, _FRAME_HEIGHT, view=view or View()) as renderer:
        return np.concatenate([renderer.draw(pose) for pose in qpos], axis=1)


def save_png(path: str | Path, image: Image) -> Path:
    """Write a picture (height, width, 3) with 128 colours, so that the file is small."""
    import PIL.Image  # Few commands need this package.

    path = Path(path)
    try:
        PIL.Image.fromarray(image).quantize(_NUM_COLOURS).save(path, format="PNG", optimize=True)
    except OSError as error:
        raise ConfigError(f"cannot write the picture {path.absolute()} ({error})") from error
    return path


@dataclass(frozen=True, kw_only=True)
class StripSettings:
    """Arguments of the command."""

    robot: str = setting("")
    """The robot's MJCF or URDF. For a clip of a shipped humanoid it is empty."""
    seconds: float = setting(0.0, minimum=0)
    """Duration (s) of the drawn part from the start of the clip; 0 selects the whole clip."""
    frames: int = setting(8, minimum=1)
    """Number of poses."""
    azimuth: float = setting(90.0)
    """Direction in degrees in which the camera looks, 90 from the right, 180 from the front."""


def draw_strip(name: str, out: str, settings: StripSettings) -> Path:
    """Write a PNG of evenly spaced poses of a clip, and return the path of the PNG."""
    clip, _, robot = load_shown_clip(name, settings.robot)
    model, poses = clip_to_qpos(clip, robot.skeleton if robot else None)
    step_s = (settings.seconds or clip.length_s) / settings.frames
    frames = np.round(np.arange(settings.frames) * step_s * clip.fps).astype(int)
    shown = poses[frames.clip(0, clip.num_frames - 1)]
    return save_png(out, draw_poses(model, shown, view_of(robot, settings.azimuth, ASPECT)))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    files = {"CLIP": "a motion file, or the name of a shipped clip", "OUT": "the PNG to write"}
    return run_file_command("strip", __doc__, StripSettings, draw_strip, arguments, **files)


if __name__ == "__main__":
    sys.exit(main())
