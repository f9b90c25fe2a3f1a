"""From the tables of a gait to a motion clip."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import poses_from_qpos, qpos_from_poses
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis.assemble import clip_from_poses, foot_frames
from tools.clip_synthesis.foot_plan import FootPlan
from tools.clip_synthesis.gait_data import Gait
from tools.clip_synthesis.leg import Leg
from tools.clip_synthesis.plan import plan_gait, right_hip_from_com
from tools.clip_synthesis.posture import set_leg, target_rotations
from tools.clip_synthesis.solve import PoseSolver
from tools.clip_synthesis.stance import Stance

FPS = 60
MODEL = "mjcf/amp_humanoid.xml"
_SIDES = (("right", -1.0), ("left", 1.0))
_PASSES = 4
_PAD = 2  # frames of the endless motion on either side, for central differences


@dataclass(frozen=True, eq=False)
class Cycle:
    """N poses of one cycle of an endless motion; the next cycle is displaced by the stride.

    Attributes:
        root_translation: (N, 3) m.
        local_rotation: (N, J, 4) xyzw.
        stride_m: displacement along x.
    """

    root_translation: FloatArray
    local_rotation: FloatArray
    stride_m: float

    def frames(self, first: int, count: int) -> tuple[FloatArray, FloatArray]:
        """Return root positions and local rotations of `count` frames from `first` (any sign)."""
        cycles, rows = np.divmod(np.arange(first, first + count), len(self.root_translation))
        root = self.root_translation[rows].copy()
        root[:, 0] += cycles * self.stride_m
        return root, self.local_rotation[rows]


def generate(gait: Gait, num_cycles: int, fps: int = FPS) -> MotionClip:
    """Make a clip of `num_cycles` cycles, plus the frame that begins the next one.

    It starts as the right foot touches down, with the root at x = 0, and travels along +x.
    Velocities are those of the endless motion, by central differences. (The filter that poselib
    applies to motion capture would take off a fifth of the run's vertical speed.)

    Raises:
        MissingPackageError: mink is not installed.
        ValueError: a cycle is no even number of frames, so that left and right could not match.
    """
    skeleton = Skeleton.from_mjcf(paths.assets_dir() / MODEL)
    cycle = solve_cycle(gait, skeleton, fps)
    count = num_cycles * len(cycle.root_translation) + 1
    root, local = cycle.frames(-_PAD, count + 2 * _PAD)
    return clip_from_poses(gait.name, fps, skeleton, root, local, _PAD)


def solve_cycle(gait: Gait, skeleton: Skeleton, fps: int) -> Cycle:
    """Plan one cycle and solve its poses; the root starts at x = 0. Raises as `generate`."""
    frames = round(gait.period_s * fps)
    if frames % 2 or abs(frames - gait.period_s * fps) > 1e-6:
        raise ValueError(
            f"a cycle of {gait.period_s:g} s has {gait.period_s * fps:g} frames at {fps} fps, "
            "expected an even number"
        )
    phase = np.arange(frames) / frames
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / MODEL))
    solver = PoseSolver(model, tuple(f"{name}_foot" for name, _ in _SIDES))
    stance = Stance(gait, Leg.from_skeleton(skeleton))
    posture = target_rotations(gait, skeleton, phase)
    solved = qpos_from_poses(skeleton, np.zeros((frames, 3)), posture)
    # Where the hips are depends on the poses, and the poses on where the hips are planned.
    for _ in range(_PASSES):
        plan = plan_gait(stance, right_hip_from_com(model, solved))
        for name, side in _SIDES:
            set_leg(posture, skeleton, name, plan.feet.leg_angles(phase, side))
        com = plan.com(phase)
        targets = qpos_from_poses(skeleton, com, posture)
        feet = [_foot_frames(plan.feet, phase, side) for _, side in _SIDES]
        solved = np.stack(
            [solver.solve(targets[i], com[i], [foot[i] for foot in feet]) for i in range(frames)]
        )
    root, local = poses_from_qpos(skeleton, solved)
    root = root - root[0] * (1.0, 0.0, 0.0)
    return Cycle(root, local, gait.stride_m)


def _foot_frames(feet: FootPlan, phase: FloatArray, side: float) -> FloatArray:
    """Return the planned frames (n, 7) of a foot at phases (n), see `foot_frames`."""
    poses = feet.poses(phase, side)
    yaw = np.full(len(phase), -side * feet.stance.yaw)
    return foot_frames(poses[:, :3], yaw, poses[:, 3])
