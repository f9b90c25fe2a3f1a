"""Helpers of the clip commands, which parse command lines and read the robot in `robot=FILE`."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.command_line import run_command
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.loader import load_single_clip
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot
from isaacgymenvs_lite.robots.settings import RobotSettings

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


def run_file_command(
    name: str,
    description: str | None,
    cls: type[T],
    action: Callable[..., object],
    arguments: Sequence[str] | None,
    **files: str,
) -> int:
    """Run `isaacgymenvs-lite NAME FILE ... key=value ...` and return the exit code.

    `files` maps the positional arguments, in capitals, to their help texts. `action` is called with
    the positional arguments and, last, the settings.
    """
    parser = argparse.ArgumentParser(prog=f"isaacgymenvs-lite {name}", description=description)
    for file, text in files.items():
        parser.add_argument(file, help=text)
    words = argparse.Namespace()

    def act(settings: T) -> None:
        action(*(getattr(words, file) for file in files), settings)

    return run_command(parser, cls, act, arguments, words)


@dataclass(frozen=True, eq=False)
class ClipRobot:
    """The robot of a clip, and the skeleton of its model."""

    prepared: PreparedRobot
    skeleton: Skeleton


def load_clip_robot(name: str, settings: RobotSettings | None = None) -> ClipRobot:
    """Read the robot of a clip, or raise a ConfigError.

    `name` is an absolute path, or a path relative to the working directory or to assets/.
    """
    folders = (Path(), paths.assets_dir())
    found = [folder / paths.user_path(name) for folder in folders]
    path = next((path for path in found if path.is_file()), None)
    if path is None:
        shipped = [f"mjcf/{path.name}" for path in sorted((folders[1] / "mjcf").glob("*.xml"))]
        looked = "" if Path(name).is_absolute() else f" in {folders[0].absolute()} and {folders[1]}"
        raise ConfigError(
            f"robot={name}: no such file{looked}; give an MJCF or URDF, or a shipped one: "
            f"{', '.join(shipped)}"
        )
    prepared = load_robot(path, settings)
    return ClipRobot(prepared, Skeleton.from_model(prepared.model, str(path)))


def load_shown_clip(name: str, robot: str) -> tuple[MotionClip, Skeleton, ClipRobot | None]:
    """Read a clip; return the clip, its skeleton, and its robot (None for a shipped humanoid)."""
    if not robot:
        return *load_single_clip(name), None
    loaded = load_clip_robot(robot)
    clip, skeleton = load_single_clip(name, [loaded.skeleton])
    return clip, skeleton, loaded


def view_of(robot: ClipRobot | None, azimuth_deg: float, aspect: float = 4 / 3) -> View:
    """Return the camera for a robot, or for a shipped humanoid if `robot` is None.

    `aspect` is the width of the picture divided by its height.
    """
    if robot is None:
        return View(azimuth_deg=azimuth_deg)
    view = View.of_model(robot.prepared.model, aspect)
    return dataclasses.replace(view, azimuth_deg=azimuth_deg)
