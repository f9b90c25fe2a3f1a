"""The source motion, and limb lengths and soles of the figure that imitates the source motion."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.mapping import WITH_ATTITUDE, SkeletonMapping
from isaacgymenvs_lite.motion.skeleton import Skeleton, shipped_humanoid_with, skeleton_for_num_dofs
from isaacgymenvs_lite.robots.limbs import ancestors
from isaacgymenvs_lite.robots.start_pose import mesh_vertices, posed
from isaacgymenvs_lite.utils import rotations

SIDES = ("right", "left")
FEET = tuple(f"{side}_foot" for side in SIDES)


@dataclass(frozen=True, eq=False)
class SourceMotion:
    """T frames of the source figure, not scaled; its bodies have the humanoid's names."""

    name: str  # name of the clip or path of the file
    fps: float  # frames per second
    places: Mapping[str, FloatArray]  # from bodies to world positions (T, 3) m of origins, z up
    # From bodies to world rotations (T, 4) xyzw, relative to the upright figure that faces +x.
    # Limbs have no rotation, because positions determine the rotations of limbs.
    turns: Mapping[str, FloatArray]
    levelled: tuple[str, ...] = ()  # feet whose soles shall become parallel to the ground


def source_from_bvh(clip: MotionClip, mapping: SkeletonMapping) -> SourceMotion:
    """Return the motion of a BVH file's clip, which must have all joints of the mapping."""
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
    """Return the source motion for a clip of a shipped humanoid, or raise an error."""
    if shipped_humanoid_with(clip.body_names) is None:
        raise MotionFileError(
            f"{clip.name}: no shipped humanoid has its {clip.num_bodies} bodies; give a clip of a "
            "shipped humanoid or a .bvh file"
        )
    places, turns = (
        dict(zip(clip.body_names, np.moveaxis(values, 1, 0), strict=True))
        for values in clip.global_poses()
    )
    return SourceMotion(clip.name, clip.fps, places, {body: turns[body] for body in WITH_ATTITUDE})


def leg_length(places: Mapping[str, FloatArray]) -> float:
    """Return the length of thigh plus shin in m, averaged over both legs and all frames."""
    total = 0.0
    for side in SIDES:
        for upper, lower in (("thigh", "shin"), ("shin", "foot")):
            way = places[f"{side}_{upper}"] - places[f"{side}_{lower}"]
            total += float(np.linalg.norm(way, axis=1).mean())
    return total / len(SIDES)


def rotated_in_body(turns: FloatArray, frame: FloatArray) -> FloatArray:
    """Return rotations (T, 4), each multiplied by the rotation `frame` (4,) in the body's axes."""
    q = torch.from_numpy(turns)
    return rotations.quat_mul(q, torch.from_numpy(frame).expand_as(q)).numpy()


def rotate(turns: FloatArray, vector: FloatArray) -> FloatArray:
    """Return a vector (3,) rotated by each quaternion (T, 4)."""
    q = torch.from_numpy(turns)
    return rotations.quat_apply(q, torch.from_numpy(vector).expand(len(q), 3)).numpy()


# Radii of the humanoid's hands and of its knees, which are the origins of the shins.
_ROUND_M = {"right_hand": 0.04, "left_hand": 0.04, "right_shin": 0.05, "left_shin": 0.05}
# The sole consists of the points of a foot up to this height above the foot's lowest point.
_SOLE_M = 0.015
# A sole with more points is reduced to its outermost points in this many horizontal directions.
_DIRECTIONS = 12
_Geom = mujoco.mjtGeom
_ENDS = tuple(itertools.product((-1.0, 1.0), repeat=3))


@dataclass(frozen=True, eq=False)
class Sole:
    """The balls and corners (balls of radius 0) of a foot that can touch the ground."""

    points: FloatArray  # (K, 3) m, centres relative to the upright foot
    radii: FloatArray  # (K,) m

    @property
    def length_m(self) -> float:
        """The largest extent of the sole along any axis, including the radii of its spheres."""
        radii = self.radii[:, None]
        extent = (self.points + radii).max(axis=0) - (self.points - radii).min(axis=0)
        return max(float(extent.max()), 1e-3)

    def places(self, feet: FloatArray, turns: FloatArray) -> FloatArray:
        """Return the lowest point (T, K, 3) m of each ball, given foot poses (T, 3) and (T, 4)."""
        centres = np.stack([feet + rotate(turns, point) for point in self.points], axis=1)
        return centres - self.radii[:, None] * np.array((0.0, 0.0, 1.0))

    def lowest(self, turns: FloatArray) -> FloatArray:
        """Return the height (T,) m of the sole's lowest point relative to the foot."""
        balls = zip(self.points, self.radii, strict=True)
        return np.min([rotate(turns, point)[:, 2] - radius for point, radius in balls], axis=0)


@dataclass(frozen=True, eq=False)
class Figure:
    """An upright figure with J bodies, which have the humanoid's names; the figure faces +x."""

    body_names: tuple[str, ...]  # J names; parents come first
    parent_indices: tuple[int, ...]  # J ids, -1 for the pelvis
    offsets: FloatArray  # (J, 3) m, relative to the parent (row 0 is not used)
    soles: Mapping[str, Sole]  # the sole of each foot
    round_m: Mapping[str, float]  # radii in m of hands and knees, which may touch the ground
    pins_feet: bool  # whether feet are held in place while they touch the ground

    @property
    def leg_length_m(self) -> float:
        """The length of thigh plus shin in m, averaged over both legs."""
        return leg_length(self.rest_places())

    def rest_places(self) -> dict[str, FloatArray]:
        """Return the positions (1, 3) m of the upright figure's bodies."""
        places: dict[str, FloatArray] = {}
        bodies = zip(self.body_names, self.parent_indices, self.offsets, strict=True)
        for body, parent, offset in bodies:
            base = places[self.body_names[parent]] if parent >= 0 else 0.0
            places[body] = base + offset[None]
        return places


def humanoid_figure(skeleton: Skeleton) -> Figure:
    """Return the figure of a shipped humanoid."""
    owners = [skeleton.body_names[body] for body in skeleton.foot_body_ids]
    soles = {}
    for foot in FEET:
        corners = skeleton.foot_corners[[owner == foot for owner in owners]]
        soles[foot] = Sole(corners, np.zeros(len(corners)))
    tree = (skeleton.body_names, skeleton.parent_indices, skeleton.local_translation)
    return Figure(*tree, soles, _ROUND_M, pins_feet=False)


def round_bodies(figure_leg_m: float, names: tuple[str, ...]) -> dict[str, float]:
    """Return radii in m of a figure's hands and knees, in proportion to the leg length."""
    humanoid_leg_m = humanoid_figure(skeleton_for_num_dofs(28)).leg_length_m
    radii = _ROUND_M.items()
    return {body: m * figure_leg_m / humanoid_leg_m for body, m in radii if body in names}


def find_sole(
    model: mujoco.MjModel, start: FloatArray, foot: str
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return centres (K, 3) m relative to the foot and radii (K,) m of the balls of a robot's sole.

    The centres are in world axes in the pose `start` (nq,), in which the robot stands with flat
    feet. The centres are corners, ends, centres or vertices of the geoms of the foot and its child
    bodies. Visual geoms are used only if there are no collision geoms. Raises ConfigError for a
    foot without geoms.
    """
    data, body = posed(model, start), model.body(foot).id
    geoms = [i for i in range(model.ngeom) if body in ancestors(model, int(model.geom_bodyid[i]))]
    colliding = [i for i in geoms if model.geom_contype[i] or model.geom_conaffinity[i]]
    parts = [_points(model, data, geom) for geom in colliding or geoms]
    if not parts:
        raise ConfigError(f"the foot '{foot}' of the robot has no geoms, expected a sole")
    centres = np.concatenate([points for points, _ in parts])
    radii = np.concatenate([np.full(len(points), radius) for points, radius in parts])
    heights = centres[:, 2] - radii
    low = np.flatnonzero(heights < heights.min() + _SOLE_M)
    if len(low) > _DIRECTIONS:
        angles = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
        ways = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        low = low[np.unique((centres[low, :2] @ ways.T).argmax(axis=0))]
    return centres[low] - data.xpos[body], radii[low]


def _points(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int
) -> tuple[npt.NDArray[np.float64], float]:
    """Return world positions (K, 3) m of the balls that form a geom, and their radius."""
    kind, size = _Geom(int(model.geom_type[geom])), model.geom_size[geom]
    radius = 0.0
    if kind == _Geom.mjGEOM_SPHERE:
        local, radius = np.zeros((1, 3)), float(size[0])
    elif kind == _Geom.mjGEOM_CAPSULE:
        local, radius = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), float(size[0])
    elif kind == _Geom.mjGEOM_MESH:
        local = mesh_vertices(model, geom).astype(np.float64)
    else:  # The points are the corners of the geom's box.
        half = (size[0], size[0], size[1]) if kind == _Geom.mjGEOM_CYLINDER else size
        local = np.array(_ENDS) * half
    return local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom], radius
