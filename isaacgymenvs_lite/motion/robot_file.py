"""The robot of the clip commands, `robot=FILE`: its file, its skeleton, clips that belong to it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError, listed
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.loader import load_single_clip
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot
from isaacgymenvs_lite.robots.settings import RobotSettings


@dataclass(frozen=True, eq=False)
class ClipRobot:
    """A robot that clips belong to.

    Attributes:
        prepared: its model, start pose and contact bodies.
        skeleton: of the model.
    """

    prepared: PreparedRobot
    skeleton: Skeleton


def robot_path(name: str) -> Path:
    """Return the file `name`: absolute, relative to the working directory, or to assets/.

    Raises:
        ConfigError: there is no such file.
    """
    folders = (Path(), paths.assets_dir())
    for folder in folders:
        path = folder / paths.user_path(name)
        if path.is_file():
            return path
    shipped = [f"mjcf/{path.name}" for path in sorted((folders[1] / "mjcf").glob("*.xml"))]
    looked = "" if Path(name).is_absolute() else f" in {folders[0].absolute()} and {folders[1]}"
    raise ConfigError(
        f"robot={name}: no such file{looked}; give an MJCF or URDF, or a shipped one: "
        f"{listed(shipped, len(shipped))}"
    )


def load_clip_robot(name: str, settings: RobotSettings | None = None) -> ClipRobot:
    """Read the robot that clips belong to.

    Args:
        name: an MJCF or URDF, see `robot_path`.
        settings: what the user says of it.

    Raises:
        ConfigError: no such file, or see `robots.load.load_robot`.
    """
    path = robot_path(name)
    prepared = load_robot(path, settings)
    return ClipRobot(prepared, Skeleton.from_model(prepared.model, str(path)))


def load_shown_clip(name: str, robot: str) -> tuple[MotionClip, Skeleton, ClipRobot | None]:
    """Read a clip to be shown, with its skeleton.

    Args:
        name: a motion file, or the name of a shipped clip.
        robot: the file of the robot that the clip belongs to; "": it is of a humanoid.

    Returns:
        The clip, its skeleton, and the robot, None for a humanoid.

    Raises:
        ConfigError: see `load_clip_robot`.
        MotionFileError: see `load_single_clip`.
    """
    if not robot:
        return *load_single_clip(name), None
    loaded = load_clip_robot(robot)
    clip, skeleton = load_single_clip(name, [loaded.skeleton])
    return clip, skeleton, loaded


def view_of(robot: ClipRobot | None, azimuth_deg: float, aspect: float = 4 / 3) -> View:
    """Return the camera for a clip of a robot; of a humanoid for None.

    Args:
        robot: what is shown.
        azimuth_deg: where the camera looks.
        aspect: width of the picture by its height.
    """
    if robot is None:
        return View(azimuth_deg=azimuth_deg)
    view = View.of_model(robot.prepared.model, aspect)
    return dataclasses.replace(view, azimuth_deg=azimuth_deg)
