"""Plots a clip: isaacgymenvs-lite plot CLIP out=FILE.png.

The picture contains three graphs over time: the joint angles (rad), the height of the root (m), and
the contacts of the feet with the ground. The angle of a ball joint is the length of its rotation
vector. A clip of a robot needs the robot's file:

    isaacgymenvs-lite plot g1_walk robot=mjcf/g1.xml out=walk.png
"""

from __future__ import annotations

import itertools
import logging
import sys
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.qpos import dofs_of_clip
from isaacgymenvs_lite.motion.robot_file import load_shown_clip, run_file_command
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.schema import setting

log = logging.getLogger(__name__)

# A foot is on the ground if it is slower than this and near its lowest height.
_CONTACT_HEIGHT_M, _CONTACT_SPEED = 0.05, 0.4
# Each joint in the legend needs this height in inches.
_LEGEND_LINE = 0.36


@dataclass(frozen=True, kw_only=True)
class PlotSettings:
    """Arguments of the command."""

    robot: str = setting("")
    """The robot's MJCF or URDF. For a clip of a shipped humanoid it is empty."""
    out: str = setting()
    """Path of the output file: .png, .svg or .pdf."""


def joint_angles(clip: MotionClip, skeleton: Skeleton) -> dict[str, npt.NDArray[np.float64]]:
    """Return the angles (T,) rad of each joint, which are unsigned for ball joints.

    The key is the body's name; for a robot's hinge, the key is the joint's name.
    """
    dofs = dofs_of_clip(skeleton, clip)
    angles = {}
    spans = itertools.pairwise(skeleton.dof_offsets)
    for body, (start, end) in zip(skeleton.dof_body_ids, spans, strict=True):
        joint = dofs[:, start:end]
        angle = joint[:, 0] if end - start == 1 else np.linalg.norm(joint, axis=1)
        by_joint = end - start == 1 and not skeleton.has_simple_joints
        shared = body in skeleton.shared_body_ids
        name = skeleton.dof_names[start] if by_joint or shared else skeleton.body_names[body]
        angles[name] = angle
    return angles


def foot_contacts(
    clip: MotionClip, feet: Collection[str] | None = None
) -> dict[str, npt.NDArray[np.bool_]]:
    """Return, for each foot and frame (T,), whether the foot is low and slow, on the ground.

    `feet` are body names. None selects the bodies with "foot" in their names.
    """
    places, _ = clip.global_poses()
    contacts = {}
    for body, name in enumerate(clip.body_names):
        if ("foot" not in name) if feet is None else (name not in feet):
            continue
        heights = places[:, body, 2]
        speeds = np.linalg.norm(clip.linear_velocity_w[:, body], axis=-1)
        low = heights < heights.min() + _CONTACT_HEIGHT_M
        contacts[name] = np.asarray(low & (speeds < _CONTACT_SPEED))
    return contacts


def plot_clip(name: str, settings: PlotSettings) -> Path:
    """Plot a clip and return the path of the picture."""
    from matplotlib.figure import Figure  # This import takes half a second.

    clip, skeleton, robot = load_shown_clip(name, settings.robot)
    angles = joint_angles(clip, skeleton)
    height = max(8.0, _LEGEND_LINE * len(angles))
    figure = Figure(figsize=(9, height), layout="constrained")
    angles_axes, root_axes, feet_axes = figure.subplots(
        3, 1, sharex=True, gridspec_kw={"height_ratios": [4, 1.5, 1]}
    )
    times_s = np.arange(clip.num_frames) / clip.fps
    for body, angle in angles.items():
        style = "--" if body.startswith("left") else "-"
        angles_axes.plot(times_s, angle, style, label=body.replace("_", " "), linewidth=1.2)
    angles_axes.set_ylabel("joint angle (rad)")
    angles_axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
    angles_axes.set_title(Path(clip.name).name)
    root_axes.plot(times_s, clip.root_translation[:, 2], color="black")
    root_axes.set_ylabel("root height (m)")
    contacts = foot_contacts(clip, robot.prepared.contact_bodies if robot else None)
    for row, contact in enumerate(contacts.values()):
        feet_axes.fill_between(times_s, row, row + 0.8, where=contact, step="mid", linewidth=0)
    feet_axes.set_yticks([row + 0.4 for row in range(len(contacts))])
    feet_axes.set_yticklabels([name.replace("_", " ") for name in contacts])
    feet_axes.set_ylabel("on the ground")
    feet_axes.set_xlabel("time (s)")
    path = Path(settings.out)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:  # An unknown format raises ValueError.
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"out={settings.out}: cannot be written ({reason})") from error
    log.info("%s: wrote %s", clip.name, path)
    return path


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    files = {"CLIP": "a motion file, or the name of a shipped clip"}
    return run_file_command("plot", __doc__, PlotSettings, plot_clip, arguments, **files)


if __name__ == "__main__":
    sys.exit(main())
