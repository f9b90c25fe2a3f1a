"""Shows or records a clip: isaacgymenvs-lite view CLIP [out=FILE.mp4].

    isaacgymenvs-lite view walk                   # repeats the clip in a window
    isaacgymenvs-lite view walk out=walk.mp4      # needs no display
    isaacgymenvs-lite view run.npy out=run.webp seconds=2 azimuth=180
    isaacgymenvs-lite view g1_walk robot=mjcf/g1.xml out=walk.mp4

CLIP is a motion file of any format, or the name of a shipped clip. A clip of a robot needs
robot=FILE, a path of the robot's MJCF or URDF or a name in assets/.
"""

from __future__ import annotations

import logging
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.motion.qpos import clip_to_qpos
from isaacgymenvs_lite.motion.robot_file import load_shown_clip, run_file_command, view_of
from isaacgymenvs_lite.rendering.display import check_display
from isaacgymenvs_lite.rendering.video import check_encoder, draw_tracks, save_video
from isaacgymenvs_lite.rendering.view import aim_camera
from isaacgymenvs_lite.schema import setting

log = logging.getLogger(__name__)

WIDTH, HEIGHT = 480, 480
"""Size of the video in pixels."""


@dataclass(frozen=True, kw_only=True)
class ViewSettings:
    """Arguments of the command."""

    robot: str = setting("")
    """The robot's MJCF or URDF. For a clip of a shipped humanoid it is empty."""
    out: str = setting("")
    """Path of the .mp4 or .webp to write. If it is empty, a window shows the clip."""
    seconds: float = setting(0.0, minimum=0)
    """Duration (s) of the video, in which a short clip repeats; 0 selects the clip's length."""
    azimuth: float = setting(90.0)
    """Direction in degrees in which the camera looks, 90 from the right, 180 from the front."""


def view_clip(name: str, settings: ViewSettings) -> None:
    """Show or record a clip on its humanoid or robot."""
    if settings.out:
        check_encoder()
    else:
        check_display("view without out=", "out=FILE.mp4")
    clip, skeleton, robot = load_shown_clip(name, settings.robot)
    model, qpos = clip_to_qpos(clip, skeleton if robot else None)
    number = max(1, round(settings.seconds * clip.fps)) if settings.seconds else clip.num_frames
    poses = qpos[np.arange(number) % clip.num_frames]
    if not settings.out:
        _show(model, poses, clip.fps, settings.azimuth)
        return
    view = view_of(robot, settings.azimuth)
    images = draw_tracks(
        model, [poses], [Path(clip.name).name], width=WIDTH, height=HEIGHT, view=view
    )
    path = save_video(settings.out, images, clip.fps)
    log.info("%s: wrote %s, %d frames at %g Hz", clip.name, path, len(poses), clip.fps)


def _show(
    model: mujoco.MjModel, poses: npt.NDArray[np.float64], fps: float, azimuth_deg: float
) -> None:
    """Repeat poses (T, nq) in a window until the window is closed."""
    from mujoco import viewer  # This import needs GLFW.

    data = mujoco.MjData(model)
    with viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as window:
        aim_camera(window.cam, model)
        window.cam.azimuth = azimuth_deg
        while window.is_running():
            for pose in poses:
                data.qpos[:] = pose
                mujoco.mj_forward(model, data)
                window.sync()
                time.sleep(1.0 / fps)
                if not window.is_running():
                    break


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    files = {"CLIP": "a motion file, or the name of a shipped clip"}
    return run_file_command("view", __doc__, ViewSettings, view_clip, arguments, **files)


if __name__ == "__main__":
    sys.exit(main())
