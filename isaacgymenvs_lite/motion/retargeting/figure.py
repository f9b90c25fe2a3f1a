"""What the targets need of the figure that is moved: lengths, soles, by the humanoid's names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.source import FEET, leg_length, rotate
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs

# Radii of the humanoid's hands and, about the origin of the shin, knees.
_ROUND_M = {"right_hand": 0.04, "left_hand": 0.04, "right_shin": 0.05, "left_shin": 0.05}


@dataclass(frozen=True, eq=False)
class Sole:
    """The points of a foot that can touch the ground: balls, of radius 0 at corners.

    Attributes:
        points: (K, 3) m, their centres relative to the foot, in the axes of the upright figure.
        radii: (K,) m.
    """

    points: FloatArray
    radii: FloatArray

    @property
    def length_m(self) -> float:
        """The largest extent along an axis, balls included."""
        radii = self.radii[:, None]
        extent = (self.points + radii).max(axis=0) - (self.points - radii).min(axis=0)
        return max(float(extent.max()), 1e-3)

    def places(self, feet: FloatArray, turns: FloatArray) -> FloatArray:
        """Return the lowest places (T, K, 3) m of the balls, for feet (T, 3) turned by (T, 4)."""
        centres = np.stack([feet + rotate(turns, point) for point in self.points], axis=1)
        return centres - self.radii[:, None] * np.array((0.0, 0.0, 1.0))

    def lowest(self, turns: FloatArray) -> FloatArray:
        """Return the height (T,) m of the lowest point over the foot."""
        heights = [
            rotate(turns, point)[:, 2] - radius
            for point, radius in zip(self.points, self.radii, strict=True)
        ]
        return np.min(heights, axis=0)


@dataclass(frozen=True, eq=False)
class Figure:
    """The upright figure that faces +x: J bodies with names of the humanoid's, parents first.

    Attributes:
        body_names: J names.
        parent_indices: J ids, -1 for the pelvis.
        offsets: (J, 3) m, of the near end of a body from its parent's; the pelvis' is not used.
        soles: of both feet.
        round_m: m, radii of bodies that may lie on the ground.
        pins_feet: whether feet in contact are held in place; else they slide as the source's.
    """

    body_names: tuple[str, ...]
    parent_indices: tuple[int, ...]
    offsets: FloatArray
    soles: Mapping[str, Sole]
    round_m: Mapping[str, float]
    pins_feet: bool

    @property
    def leg_length_m(self) -> float:
        """The length of thigh and shin, the mean of both legs."""
        return leg_length(self.rest_places())

    def rest_places(self) -> dict[str, FloatArray]:
        """Return the places (1, 3) m of the upright figure's bodies."""
        places: dict[str, FloatArray] = {}
        for body, parent, offset in zip(
            self.body_names, self.parent_indices, self.offsets, strict=True
        ):
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
    return Figure(
        skeleton.body_names,
        skeleton.parent_indices,
        skeleton.local_translation,
        soles,
        _ROUND_M,
        pins_feet=False,
    )


def round_bodies(figure_leg_m: float, names: tuple[str, ...]) -> dict[str, float]:
    """Return radii of hands and knees of another figure, in proportion to its legs."""
    humanoid_leg_m = humanoid_figure(skeleton_for_num_dofs(28)).leg_length_m
    return {
        body: radius * figure_leg_m / humanoid_leg_m
        for body, radius in _ROUND_M.items()
        if body in names
    }
