"""Prints the measurements of clips as Markdown tables, for the log and docs/shipped_clips.md."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations
from tools.clip_synthesis import checks, model_checks

# The columns of the overview map names of measurements to short headings.
_OVERVIEW = {
    "frames, length": "frames, length",
    "mean speed of the root": "speed",
    "turn": "turn",
    "height of the root": "height of the root",
    "way of a touching corner, at most": "skating",
    "clearance of a swinging foot": "clearance",
    "vertical ground force": "ground force",
    "centre of pressure outside of the soles": "pressure outside of the soles",
    "nearest joint limit": "joint limit",
    "fastest joint": "fastest joint",
}


def figures(clip: MotionClip, skeleton: Skeleton, model: mujoco.MjModel) -> dict[str, str]:
    """Return name -> value with unit of all measurements of a clip."""
    feet = checks.foot_figures(clip, skeleton)
    force = model_checks.ground_force(clip, skeleton, model)[:, 2]
    touch = model_checks.deepest_self_contact(clip, skeleton, model)
    outside = model_checks.pressure_outside(clip, skeleton, model)
    height = clip.root_translation[:, 2]
    way = np.linalg.norm(np.diff(clip.root_translation[:, :2], axis=0), axis=1).sum()
    clearance = feet.swing_clearance_m
    return {
        "frames, length": f"{clip.num_frames} at {clip.fps:g} fps, {clip.length_s:.2f} s",
        "mean speed of the root": f"{way / clip.length_s:.2f} m/s",
        "turn": f"{round(np.degrees(turn_rad(clip)))} deg",
        "height of the root": f"{height.min():.3f} to {height.max():.3f} m",
        "way of a touching corner, at most": f"{1e3 * feet.worst_slip_m:.1f} mm",
        "below the ground, at most": f"{1e3 * feet.deepest_m:.2f} mm",
        "lower foot above the ground, at most": f"{1e3 * feet.highest_m:.1f} mm",
        "clearance of a swinging foot": "-" if np.isnan(clearance) else f"{1e3 * clearance:.0f} mm",
        "both feet on the ground": f"{100 * feet.double_support_share:.0f} % of the time",
        "no foot on the ground": f"{100 * feet.flight_share:.0f} % of the time",
        "vertical ground force": f"{force.min():z.2f} to {force.max():.2f} body weights",
        "centre of pressure outside of the soles": (
            f"{1e3 * np.nanmean(outside):.0f} mm, at most {1e3 * np.nanmax(outside):.0f} mm"
        ),
        "bodies into each other, at most": f"{1e3 * touch:.1f} mm",
        "nearest joint limit": f"{np.degrees(checks.limit_margin(clip, skeleton)):.1f} deg away",
        "fastest joint": f"{checks.peak_joint_speed(clip, skeleton):.1f} rad/s",
    }


def cycle_figures(clip: MotionClip, frames_per_cycle: int) -> dict[str, str]:
    """Return the measurements of a clip's periodicity; see `figures`."""
    turn_error, place_error = checks.closure_error(clip, frames_per_cycle)
    seam_linear, seam_angular = checks.velocity_seam(clip)
    mirror_turn, mirror_place = checks.symmetry_error(clip, frames_per_cycle)
    return {
        "cycles": f"{(clip.num_frames - 1) / frames_per_cycle:g} of {frames_per_cycle} frames",
        "closure of a cycle": f"{turn_error:.1e} rad, {place_error:.1e} m",
        "velocity step at the seam": f"{seam_linear:.1e} m/s, {seam_angular:.1e} rad/s",
        "left against right": f"{mirror_turn:.1e} rad, {mirror_place:.1e} m",
    }


def describe(rows: dict[str, str]) -> str:
    """Return the measurements of one clip as a Markdown table."""
    width = max(len(key) for key in rows)
    return "\n".join(f"| {key:<{width}} | {value} |" for key, value in rows.items())


def overview(clips: dict[str, dict[str, str]]) -> str:
    """Return the main measurements of several clips as a Markdown table with one row per clip."""
    lines = [f"| clip | {' | '.join(_OVERVIEW.values())} |", "|---" * (len(_OVERVIEW) + 1) + "|"]
    for name, rows in clips.items():
        lines.append(f"| `{name}` | {' | '.join(rows[key] for key in _OVERVIEW)} |")
    return "\n".join(lines)


def turn_rad(clip: MotionClip) -> float:
    """Return the change of the heading over the clip in rad, not wrapped, left positive."""
    heading = rotations.calc_heading(torch.from_numpy(clip.local_rotation[:, 0]).double()).numpy()
    turned = np.unwrap(heading)
    return float(turned[-1] - turned[0])
