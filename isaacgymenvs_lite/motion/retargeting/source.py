"""The motion to retarget, of a BVH file or a clip: places and attitudes by the humanoid's names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.mapping import WITH_ATTITUDE, SkeletonMapping
from isaacgymenvs_lite.motion.skeleton import shipped_humanoid_with
from isaacgymenvs_lite.utils import rotations

SIDES = ("right", "left")
FEET = tuple(f"{side}_foot" for side in SIDES)


@dataclass(frozen=True, eq=False)
class SourceMotion:
    """T frames of a figure in its own size; its bodies have the names of the humanoid's.

    Attributes:
        name: of the clip or file.
        fps: frames per second.
        places: (T, 3) m of the near end of each body, in the world, z up.
        turns: (T, 4) xyzw, attitudes in the world; the identity is the upright figure that faces
            +x. Limbs have none: their attitudes follow from the places.
        levelled: feet whose soles are made parallel to the ground, see `targets`.
    """

    name: str
    fps: float
    places: Mapping[str, FloatArray]
    turns: Mapping[str, FloatArray]
    levelled: tuple[str, ...] = ()


def source_from_bvh(clip: MotionClip, mapping: SkeletonMapping) -> SourceMotion:
    """Return the motion of a BVH file's skeleton, in m, z up; it has the joints of the mapping."""
    everywhere, attitudes = clip.global_poses()
    index = {body: clip.body_names.index(s.joint) for body, s in mapping.sources.items()}
    return SourceMotion(
        name=clip.name,
        fps=clip.fps,
        places={body: everywhere[:, joint] for body, joint in index.items()},
        turns={
            body: rotated_in_body(attitudes[:, index[body]], entry.frame)
            for body, entry in mapping.sources.items()
            if entry.frame is not None
        },
        levelled=tuple(foot for foot in FEET if mapping.sources[foot].level),
    )


def source_from_clip(clip: MotionClip) -> SourceMotion:
    """Return the motion of a clip of a shipped humanoid.

    Raises:
        MotionFileError: no shipped humanoid has these bodies.
    """
    if shipped_humanoid_with(clip.body_names) is None:
        raise MotionFileError(
            f"{clip.name}: no shipped humanoid has its {clip.num_bodies} bodies, so that it cannot "
            "be retargeted; give a clip of a shipped humanoid or a .bvh file"
        )
    places, turns = (
        dict(zip(clip.body_names, np.moveaxis(values, 1, 0), strict=True))
        for values in clip.global_poses()
    )
    return SourceMotion(clip.name, clip.fps, places, {body: turns[body] for body in WITH_ATTITUDE})


def leg_length(places: Mapping[str, FloatArray]) -> float:
    """Return the length of thigh and shin, the mean of both legs and all frames of (T, 3)."""
    total = 0.0
    for side in SIDES:
        for upper, lower in (("thigh", "shin"), ("shin", "foot")):
            way = places[f"{side}_{upper}"] - places[f"{side}_{lower}"]
            total += float(np.linalg.norm(way, axis=1).mean())
    return total / len(SIDES)


def rotated_in_body(turns: FloatArray, frame: FloatArray) -> FloatArray:
    """Return rotations (T, 4) after the rotation `frame` (4,) in the body's own axes."""
    q = torch.from_numpy(turns)
    return rotations.quat_mul(q, torch.from_numpy(frame).expand_as(q)).numpy()


def rotate(turns: FloatArray, vector: FloatArray) -> FloatArray:
    """Return a vector (3,) rotated by each of (T, 4)."""
    q = torch.from_numpy(turns)
    return rotations.quat_apply(q, torch.from_numpy(vector).expand(len(q), 3)).numpy()
