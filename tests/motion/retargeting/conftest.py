"""Writes BVH files for the tests: clips of the humanoid as motion of other skeletons.

They are written by forward kinematics alone, with the joints, channels and units of CMU and LAFAN1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.motion.clip import MotionClip

# From our axes (x forward, y left, z up) to those of the files (z forward, x left, y up).
TO_FILE = Rotation.from_matrix([[0, 1, 0], [0, 0, 1], [1, 0, 0]])


@dataclass(frozen=True)
class Rig:
    """A skeleton of BVH files.

    Attributes:
        joints: (name, parent, body of the humanoid that it is, or "" for one that does not move),
            parents first.
        frames: of each body, the rotation of the body's frame relative to the joint's; of others
            none.
        unit_m: m per unit of the file.
        order: of the rotation channels, as their axes.
    """

    joints: tuple[tuple[str, str, str], ...]
    frames: dict[str, Rotation]
    unit_m: float
    order: str


def _axes(x: str, z: str, about: str = "x", degrees: float = 0.0) -> Rotation:
    """Return the frame whose x and z are axes of the joint, turned about an own axis."""

    def vector(name: str) -> np.ndarray:
        return np.eye(3)["xyz".index(name[1])] * (1.0 if name[0] == "+" else -1.0)

    matrix = np.stack((vector(x), np.cross(vector(z), vector(x)), vector(z)), axis=1)
    return Rotation.from_matrix(matrix) * Rotation.from_euler(about, degrees, degrees=True)


def _sides(make) -> dict[str, Rotation]:
    return {k: v for side, sign in (("left", 1.0), ("right", -1.0)) for k, v in make(side, sign)}


CMU = Rig(
    joints=(
        ("Hips", "", "pelvis"),
        ("LHipJoint", "Hips", ""),
        ("LeftUpLeg", "LHipJoint", "left_thigh"),
        ("LeftLeg", "LeftUpLeg", "left_shin"),
        ("LeftFoot", "LeftLeg", "left_foot"),
        ("LeftToeBase", "LeftFoot", ""),
        ("RHipJoint", "Hips", ""),
        ("RightUpLeg", "RHipJoint", "right_thigh"),
        ("RightLeg", "RightUpLeg", "right_shin"),
        ("RightFoot", "RightLeg", "right_foot"),
        ("RightToeBase", "RightFoot", ""),
        ("LowerBack", "Hips", ""),
        ("Spine", "LowerBack", ""),
        ("Spine1", "Spine", "torso"),
        ("Neck", "Spine1", ""),
        ("Neck1", "Neck", ""),
        ("Head", "Neck1", "head"),
        ("LeftShoulder", "Spine1", ""),
        ("LeftArm", "LeftShoulder", "left_upper_arm"),
        ("LeftForeArm", "LeftArm", "left_lower_arm"),
        ("LeftHand", "LeftForeArm", "left_hand"),
        ("LThumb", "LeftHand", ""),
        ("RightShoulder", "Spine1", ""),
        ("RightArm", "RightShoulder", "right_upper_arm"),
        ("RightForeArm", "RightArm", "right_lower_arm"),
        ("RightHand", "RightForeArm", "right_hand"),
        ("RThumb", "RightHand", ""),
    ),
    frames={
        **dict.fromkeys(("pelvis", "torso", "head"), _axes("+z", "+y")),
        # In the rest pose the arms point sideways; the legs, with the feet, are spread by 20 deg.
        **_sides(
            lambda side, sign: [
                (f"{side}_{part}", _axes("+z", "-x" if sign > 0 else "+x"))
                for part in ("upper_arm", "lower_arm", "hand")
            ]
        ),
        **_sides(
            lambda side, sign: [
                (f"{side}_{part}", _axes("+z", "+y", "x", 20.0 * sign))
                for part in ("thigh", "shin", "foot")
            ]
        ),
    },
    unit_m=0.056444,
    order="ZYX",
)

LAFAN1 = Rig(
    joints=(
        ("Hips", "", "pelvis"),
        ("LeftUpLeg", "Hips", "left_thigh"),
        ("LeftLeg", "LeftUpLeg", "left_shin"),
        ("LeftFoot", "LeftLeg", "left_foot"),
        ("LeftToe", "LeftFoot", ""),
        ("RightUpLeg", "Hips", "right_thigh"),
        ("RightLeg", "RightUpLeg", "right_shin"),
        ("RightFoot", "RightLeg", "right_foot"),
        ("RightToe", "RightFoot", ""),
        ("Spine", "Hips", ""),
        ("Spine1", "Spine", ""),
        ("Spine2", "Spine1", "torso"),
        ("Neck", "Spine2", ""),
        ("Head", "Neck", "head"),
        ("LeftShoulder", "Spine2", ""),
        ("LeftArm", "LeftShoulder", "left_upper_arm"),
        ("LeftForeArm", "LeftArm", "left_lower_arm"),
        ("LeftHand", "LeftForeArm", "left_hand"),
        ("RightShoulder", "Spine2", ""),
        ("RightArm", "RightShoulder", "right_upper_arm"),
        ("RightForeArm", "RightArm", "right_lower_arm"),
        ("RightHand", "RightForeArm", "right_hand"),
    ),
    frames={
        **dict.fromkeys(("pelvis", "torso", "head"), _axes("+y", "+x")),
        # The bones of the limbs are the x axes of their joints; a foot's slopes by 25 deg.
        **_sides(
            lambda side, sign: [
                (f"{side}_{part}", _axes("-y", "-x"))
                for part in ("upper_arm", "lower_arm", "hand", "thigh", "shin")
            ]
        ),
        **_sides(lambda side, sign: [(f"{side}_foot", _axes("+x", "+y", "y", -25.0))]),
    },
    unit_m=0.01,
    order="ZYX",
)


RIGS = {"cmu": CMU, "lafan1": LAFAN1}


@pytest.fixture
def write_bvh() -> Callable[..., Path]:
    """Return `write_bvh(path, clip, rig, ...)`, rig being "cmu" or "lafan1"; see `_write_bvh`."""
    pytest.importorskip("pybvh")
    pytest.importorskip("mink")
    return lambda path, clip, rig, **shape: _write_bvh(path, clip, RIGS[rig], **shape)


def _write_bvh(
    path: Path,
    clip: MotionClip,
    rig: Rig,
    size: float = 1.0,
    arms: float = 1.0,
    order: str = "",
    axes: Rotation | None = None,
    joint_axes: Rotation | None = None,
    unit_m: float | None = None,
) -> Path:
    """Write a clip of the humanoid as the motion of a rig.

    Args:
        path: of the file.
        clip: the motion.
        rig: the skeleton.
        size: its size divided by the humanoid's; its height over the ground scales too.
        arms: the length of its arms, by what the humanoid's would be at this size.
        order: of the rotation channels; "": the rig's.
        axes: from the usual axes of the files to the axes of this file.
        joint_axes: the same of all joints.
        unit_m: m per unit of length; None: the rig's.
    """
    frames = rig.frames
    if joint_axes is not None:
        frames = {body: joint_axes * frame for body, frame in frames.items()}
    rig = Rig(rig.joints, frames, unit_m or rig.unit_m, order or rig.order)
    to_file = TO_FILE if axes is None else axes * TO_FILE
    positions, turns = clip.global_poses()
    world: dict[str, Rotation] = {}
    offsets: dict[str, np.ndarray] = {}
    angles: dict[str, np.ndarray] = {}
    holder: dict[str, str] = {}  # the body whose frame a joint's parent moves with
    for name, parent, body in rig.joints:
        above = holder.get(parent, "")
        holder[name] = body or above
        own = holder[name]
        index = clip.body_names.index(own)
        world[name] = to_file * Rotation.from_quat(turns[:, index]) * rig.frames[own].inv()
        if not parent:
            local, offsets[name] = world[name], np.zeros(3)
        else:
            local = world[parent].inv() * world[name]
            offset = np.zeros(3)
            if body and above != body:
                offset = rig.frames[above].apply(clip.local_translation[index])
                offset *= arms if body.endswith(("lower_arm", "hand")) else 1.0
            elif not body and "Toe" in name:
                offset = rig.frames[own].apply([0.12, 0.0, -0.03])
            offsets[name] = offset * size / rig.unit_m
        angles[name] = local.as_euler(rig.order, degrees=True)
    root = to_file.apply(positions[:, 0]) * size / rig.unit_m
    rows = np.concatenate([root, *[angles[name] for name, _, _ in rig.joints]], axis=1)
    head = [*_hierarchy(rig, offsets, ""), "MOTION", f"Frames: {clip.num_frames}"]
    head.append(f"Frame Time: {1.0 / clip.fps:.6f}")
    text = [*head, *(" ".join(f"{value:.6f}" for value in row) for row in rows)]
    path.write_text("\n".join(["HIERARCHY", *text]) + "\n")
    return path


def _hierarchy(rig: Rig, offsets: dict[str, np.ndarray], parent: str, depth: int = 0) -> list[str]:
    lines: list[str] = []
    tab = "\t" * depth
    rotation = " ".join(f"{axis}rotation" for axis in rig.order)
    for name, above, _ in rig.joints:
        if above != parent:
            continue
        kind, channels = (
            ("JOINT", f"3 {rotation}")
            if parent
            else ("ROOT", f"6 Xposition Yposition Zposition {rotation}")
        )
        lines += [f"{tab}{kind} {name}", f"{tab}{{"]
        lines.append(f"{tab}\tOFFSET " + " ".join(f"{value:.6f}" for value in offsets[name]))
        lines.append(f"{tab}\tCHANNELS {channels}")
        children = _hierarchy(rig, offsets, name, depth + 1)
        end = [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET 0 0 0", f"{tab}\t}}"]
        lines += [*(children or end), f"{tab}}}"]
    return lines
