"""Checks the file of a robot: isaacgymenvs-lite robot FILE [out=FILE.png].

    isaacgymenvs-lite robot mjcf/g1.xml               # lists used and added parts
    isaacgymenvs-lite robot /robots/g1.urdf out=start.png

FILE is an MJCF or URDF: an absolute path, a path relative to the working directory, or a name in
assets/. The command reads the file like task=RobotAMP. The picture shows the start pose from the
right and from the front. The picture needs EGL or OSMesa, which render without a screen.
"""

from __future__ import annotations

import logging
import sys
import textwrap
from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.robot_file import load_clip_robot, run_file_command, view_of
from isaacgymenvs_lite.motion.strip import ASPECT, draw_poses, save_png
from isaacgymenvs_lite.schema import setting

log = logging.getLogger(__name__)

_COLUMNS = 100
_AZIMUTHS_DEG = (90.0, 180.0)


@dataclass(frozen=True, kw_only=True)
class RobotCheckSettings:
    """Arguments of the command."""

    out: str = setting("")
    """Path of the PNG. If it is empty, no picture is drawn."""


def check_robot(file: str, settings: RobotCheckSettings) -> None:
    """Log what RobotAMP uses from a robot's file and what RobotAMP adds; draw the start pose."""
    robot = load_clip_robot(file)
    for line in robot.prepared.describe():
        for part in textwrap.wrap(line, _COLUMNS, subsequent_indent="    "):
            log.info("%s", part)
    if settings.out:
        pose = robot.prepared.start_qpos[None]
        views = [view_of(robot, azimuth_deg, ASPECT) for azimuth_deg in _AZIMUTHS_DEG]
        panels = [draw_poses(robot.prepared.model, pose, view) for view in views]
        path = save_png(settings.out, np.concatenate(panels, axis=1))
        log.info("wrote %s", path)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    files = {"FILE": "an MJCF or URDF of a robot"}
    return run_file_command("robot", __doc__, RobotCheckSettings, check_robot, arguments, **files)


if __name__ == "__main__":
    sys.exit(main())
