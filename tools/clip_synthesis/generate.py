"""Plans a gait from its tables and makes a motion clip of it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import poses_from_qpos, qpos_from_poses
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis import dynamics
from tools.clip_synthesis.assemble import clip_from_poses, foot_frames
from tools.clip_synthesis.com_plan import ComPlan, plan_com
from tools.clip_synthesis.cycle import PeriodicCurve
from tools.clip_synthesis.foot_plan import FootPlan, Stance
from tools.clip_synthesis.gait_data import Gait
from tools.clip_synthesis.leg import Leg
from tools.clip_synthesis.posture import set_leg, target_rotations
from tools.clip_synthesis.solve import PoseSolver

FPS = 60
MODEL = "mjcf/amp_humanoid.xml"
_SIDES = (("right", -1.0), ("left", 1.0))
_HIP_HARMONICS = 10
_HEIGHT_STEPS = 4  # each step of the search reduces the error of the height at least tenfold
_PASSES = 4
_PAD = 2  # additional frames at both ends for central differences


def generate(gait: Gait, num_cycles: int, fps: int = FPS) -> MotionClip:
    """Make a clip of `num_cycles` cycles plus the first frame of the next cycle.

    The clip starts with the touch-down of the right foot. The root starts at x = 0 and travels
    along +x. Velocities are central differences. (The filter that poselib applies to motion capture
    would reduce the vertical speed of a run by a fifth.)

    Raises:
        MissingPackageError: mink is not installed.
        ValueError: the number of frames of a cycle is odd, and left and right cannot match.
    """
    skeleton = Skeleton.from_mjcf(paths.assets_dir() / MODEL)
    cycle_root, cycle_local = solve_cycle(gait, skeleton, fps)
    frames = np.arange(-_PAD, num_cycles * len(cycle_root) + 1 + _PAD)
    cycles, rows = np.divmod(frames, len(cycle_root))
    root = cycle_root[rows]
    root[:, 0] += cycles * gait.stride_m
    return clip_from_poses(gait.name, fps, skeleton, root, cycle_local[rows], _PAD)


def solve_cycle(gait: Gait, skeleton: Skeleton, fps: int) -> tuple[FloatArray, FloatArray]:
    """Return root positions (n, 3) in m and local rotations (n, J, 4) xyzw of one cycle."""
    frames = round(gait.period_s * fps)
    if frames % 2 or abs(frames - gait.period_s * fps) > 1e-6:
        raise ValueError(
            f"a cycle of {gait.period_s:g} s has {gait.period_s * fps:g} frames at {fps} fps, "
            "expected an even number; change period_s or fps"
        )
    phase = np.arange(frames) / frames
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / MODEL))
    solver = PoseSolver(model, tuple(f"{name}_foot" for name, _ in _SIDES))
    stance = Stance(gait, Leg.from_skeleton(skeleton))
    posture = target_rotations(gait, skeleton, phase)
    solved = qpos_from_poses(skeleton, np.zeros((frames, 3)), posture)
    # The poses depend on the planned hips, and the hips depend on the poses.
    for _ in range(_PASSES):
        centre, hips = dynamics.com_and_hips(model, solved)
        plan = plan_gait(stance, hips[:, 0] - centre)
        for name, side in _SIDES:
            set_leg(posture, skeleton, name, plan.feet.leg_angles(phase, side))
        com = plan.com(phase)
        targets = qpos_from_poses(skeleton, com, posture)
        feet = [_foot_frames(plan.feet, phase, side) for _, side in _SIDES]
        solved = np.stack(
            [solver.solve(targets[i], com[i], [foot[i] for foot in feet]) for i in range(frames)]
        )
    root, local = poses_from_qpos(skeleton, solved)
    return root - root[0] * (1.0, 0.0, 0.0), local


def _foot_frames(feet: FootPlan, phase: FloatArray, side: float) -> FloatArray:
    """Return the planned frames (n, 7) of a foot at phases (n); see `foot_frames`."""
    poses = feet.poses(phase, side)
    yaw = np.full(len(phase), -side * feet.stance.yaw)
    return foot_frames(poses[:, :3], yaw, poses[:, 3])


@dataclass(frozen=True, eq=False)
class GaitPlan:
    """Targets of the inverse kinematics as functions of the phase."""

    com: ComPlan
    feet: FootPlan


def plan_gait(stance: Stance, hip_from_com: FloatArray) -> GaitPlan:
    """Plan the motion of the centre of mass and of the feet.

    The height of the body follows from the smallest knee flexion of the gait during the stance.

    Args:
        stance: poses of the foot on the ground.
        hip_from_com: (N, 3) m, from the centre of mass to the right hip at N evenly spaced phases.
    """
    curves = [PeriodicCurve.through(hip_from_com[:, axis], _HIP_HARMONICS) for axis in range(3)]
    knee = np.radians(np.array([stance.gait.straightest_knee_deg]))
    longest = float(stance.leg.reach(knee).item())

    def plan(height_m: float) -> GaitPlan:
        com = plan_com(stance, height_m)

        def right_hip(phase: FloatArray) -> FloatArray:
            return com(phase) + np.stack([curve(phase) for curve in curves], axis=-1)

        return GaitPlan(com, FootPlan(stance, right_hip))

    height_m = longest
    for _ in range(_HEIGHT_STEPS):
        # The search converges quickly, because nearly vertical legs lengthen as the body rises.
        height_m += longest - plan(height_m).feet.stance_reach().max()
    return plan(height_m)
