"""Renders a clip as a strip of frames: isaacgymenvs-lite strip CLIP OUT.png.

    isaacgymenvs-lite strip walk walk.png seconds=0.9 frames=8 azimuth=180
    isaacgymenvs-lite strip g1_walk walk.png robot=mjcf/g1.xml

CLIP is a motion file of any format, or the name of a shipped one; a clip of a robot needs its file,
robot=. The strip shows the first `seconds` of it (default: all) in `frames` poses (8), from the
right (azimuth=90).

Needs an OpenGL library that works without a screen, EGL or OSMesa; see `rendering`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.command_line import run_command
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.qpos import clip_to_qpos
from isaacgymenvs_lite.motion.robot_file import ClipRobot, load_shown_clip, view_of
from isaacgymenvs_lite.rendering.scene import Image, SceneRenderer
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.schema import keys_of, setting
from isaacgymenvs_lite.utils.optional_packages import import_package, require

_FRAME_WIDTH, _FRAME_HEIGHT = 200, 320
ASPECT = _FRAME_WIDTH / _FRAME_HEIGHT
"""Width of the picture of a pose by its height."""
_NUM_COLOURS = 128


def draw_poses(
    model: mujoco.MjModel, qpos: npt.NDArray[np.float64], view: View | None = None
) -> Image:
    """Draw poses (n, nq) side by side, each from a camera of its own.

    Args:
        model: of the figure.
        qpos: joint positions in MuJoCo's order.
        view: the camera's; None: a humanoid's, from the right side.

    Returns:
        A picture (height, n * width, 3).

    Raises:
        RenderingError: this machine cannot draw.
    """
    with SceneRenderer(model, _FRAME_WIDTH, _FRAME_HEIGHT, view=view or View()) as renderer:
        return np.concatenate([renderer.draw(pose) for pose in qpos], axis=1)


def save_strip(
    clip: MotionClip,
    path: str | Path,
    span_s: float,
    num_frames: int = 8,
    azimuth_deg: float = 90.0,
    robot: ClipRobot | None = None,
) -> Path:
    """Write a PNG with `num_frames` poses, evenly spaced over the first `span_s`, side by side.

    Args:
        clip: see `clip_to_qpos`.
        path: the file.
        span_s: time to show; the poses are those nearest in the clip.
        num_frames: number of poses.
        azimuth_deg: where the camera looks: 90 from the right side, 180 from the front.
        robot: that the clip belongs to; None: a shipped humanoid.

    Raises:
        MissingPackageError: Pillow is not installed.
        RenderingError: this machine cannot draw.
    """
    require("PIL", "writing pictures")  # before the drawing
    model, poses = clip_to_qpos(clip, robot.skeleton if robot else None)
    times_s = np.arange(num_frames) * (span_s / num_frames)
    frames = np.round(times_s * clip.fps).astype(int).clip(0, clip.num_frames - 1)
    return save_png(path, draw_poses(model, poses[frames], view_of(robot, azimuth_deg, ASPECT)))


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


@dataclass(frozen=True, kw_only=True)
class StripSettings:
    """Arguments of the command."""

    robot: str = setting("")
    """The robot's MJCF or URDF; '': the clip is of a shipped humanoid."""
    seconds: float = setting(0.0, minimum=0)
    """Time to show; 0: the whole clip."""
    frames: int = setting(8, minimum=1)
    """Number of poses."""
    azimuth: float = setting(90.0)
    """Degrees: 90 from the right, 180 from the front."""


def draw_strip(name: str, out: Path, settings: StripSettings) -> Path:
    """Render a clip, named as on the command line, as a strip of poses; return the file.

    Raises:
        UserError: the clip cannot be read, or the picture cannot be drawn or written.
    """
    clip, _, robot = load_shown_clip(name, settings.robot)
    seconds = settings.seconds or clip.length_s
    return save_strip(clip, out, seconds, settings.frames, settings.azimuth, robot)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="isaacgymenvs-lite strip", description=__doc__)
    parser.add_argument("clip", metavar="CLIP", help="a motion file, or the name of a shipped clip")
    parser.add_argument("out", metavar="OUT", type=Path, help="the PNG to write")
    words = argparse.Namespace()
    return run_command(
        parser,
        StripSettings,
        lambda settings: draw_strip(words.clip, words.out, settings),
        _without_dashes(sys.argv[1:] if arguments is None else arguments),
        words,
    )


def _without_dashes(words: Sequence[str]) -> list[str]:
    """Write `--seconds 2`, the command's older form, as `seconds=2`."""
    options = {f"--{key}": key for key in keys_of(StripSettings)}
    plain, rest = list[str](), iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if name in options:
            plain.append(f"{options[name]}={value if equals else next(rest, '')}")
        else:
            plain.append(word)
    return plain


if __name__ == "__main__":
    sys.exit(main())
