"""The measured figures of a clip as a Markdown table, for the log and for docs/shipped_clips.md."""

from __future__ import annotations

import mujoco
import numpy as np

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.motion.synthesis import checks, model_checks


def describe(
    clip: MotionClip, frames_per_cycle: int, skeleton: Skeleton, model: mujoco.MjModel
) -> str:
    """Measure a periodic clip; one table row per figure."""
    feet = checks.foot_figures(clip, skeleton)
    force = model_checks.ground_force(clip, skeleton, model)[:, 2]
    touch = model_checks.deepest_self_contact(clip, skeleton, model)
    turn_error, place_error = checks.closure_error(clip, frames_per_cycle)
    seam_linear, seam_angular = checks.velocity_seam(clip)
    mirror_turn, mirror_place = checks.symmetry_error(clip, frames_per_cycle)
    height = clip.root_translation[:, 2]
    speed = (clip.root_translation[-1, 0] - clip.root_translation[0, 0]) / clip.length_s
    rows = {
        "frames, length": f"{clip.num_frames} at {clip.fps:g} fps, {clip.length_s:.2f} s",
        "cycles": f"{(clip.num_frames - 1) / frames_per_cycle:g} of {frames_per_cycle} frames",
        "forward speed": f"{speed:.2f} m/s",
        "height of the root": f"{height.min():.3f} to {height.max():.3f} m",
        "way of a touching corner, at most": f"{1e3 * feet.worst_slip_m:.2f} mm",
        "below the ground, at most": f"{1e3 * feet.deepest_m:.2f} mm",
        "lower foot above the ground, at most": f"{1e3 * feet.highest_m:.1f} mm",
        "clearance of a swinging foot": f"{1e3 * feet.swing_clearance_m:.0f} mm",
        "both feet on the ground": f"{100 * feet.double_support_share:.0f} % of the time",
        "no foot on the ground": f"{100 * feet.flight_share:.0f} % of the time",
        "vertical ground force": f"{force.min():.2f} to {force.max():.2f} body weights",
        "bodies into each other, at most": f"{1e3 * touch:.1f} mm",
        "closure of a cycle": f"{turn_error:.1e} rad, {place_error:.1e} m",
        "velocity step at the seam": f"{seam_linear:.1e} m/s, {seam_angular:.1e} rad/s",
        "left against right": f"{mirror_turn:.1e} rad, {mirror_place:.1e} m",
        "nearest joint limit": f"{np.degrees(checks.limit_margin(clip, skeleton)):.1f} deg away",
        "fastest joint": f"{checks.peak_joint_speed(clip, skeleton):.1f} rad/s",
    }
    width = max(len(key) for key in rows)
    return "\n".join(f"| {key:<{width}} | {value} |" for key, value in rows.items())
