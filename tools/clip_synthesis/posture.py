"""Computes the rotations of all bodies from the published angles of a gait."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations
from tools.clip_synthesis.cycle import PeriodicCurve
from tools.clip_synthesis.gait_data import Gait

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def target_rotations(gait: Gait, skeleton: Skeleton, phase: FloatArray) -> FloatArray:
    """Return rotations relative to the parents (n, J, 4) xyzw at phases (n).

    The root's rotation is relative to the world. The head stays upright and looks ahead, as in
    people (Pozzo, Berthoz and Lefort, Exp. Brain Res. 82 (1990) 97-106).
    """
    turns = {name: turn("x", np.zeros_like(phase)) for name in skeleton.body_names}
    pelvis = compose(
        turn("z", PeriodicCurve.odd(gait.pelvis_rotation)(phase)),
        turn("y", PeriodicCurve.even(gait.pelvis_tilt)(phase)),
        turn("x", -PeriodicCurve.odd(gait.pelvis_obliquity)(phase)),
    )
    thorax = compose(
        turn("z", PeriodicCurve.odd(gait.thorax_rotation)(phase)),
        turn("y", np.full_like(phase, np.radians(gait.thorax_lean_deg))),
    )
    turns["pelvis"] = pelvis
    turns["torso"] = rotations.quat_mul(rotations.quat_conjugate(pelvis), thorax)
    turns["head"] = rotations.quat_conjugate(thorax)
    for side, sign, late in (("right", -1.0, 0.0), ("left", 1.0, 0.5)):
        turns |= _limbs(gait, side, sign, phase - late)
    return torch.stack([turns[name] for name in skeleton.body_names], dim=1).numpy()


def set_leg(
    local_rotation: FloatArray,
    skeleton: Skeleton,
    side: str,
    angles: tuple[FloatArray, FloatArray, FloatArray],
    yaw: FloatArray | None = None,
) -> None:
    """Write the rotations of one leg's bodies into `local_rotation` (n, J, 4) xyzw.

    Args:
        local_rotation: rotations relative to the parents, changed in place.
        skeleton: the J bodies.
        side: `right` or `left`.
        angles: thigh to the vertical, knee, foot to the ground, each (n) in rad.
        yaw: (n) rad, direction of the leg's plane about z; by default +x.
    """
    thigh, knee, pitch = angles
    pelvis = torch.from_numpy(local_rotation[:, 0])
    plane = turn("z", np.zeros_like(thigh) if yaw is None else yaw)
    turns = {
        f"{side}_thigh": compose(rotations.quat_conjugate(pelvis), plane, turn("y", -thigh)),
        f"{side}_shin": turn("y", knee),
        f"{side}_foot": turn("y", thigh - knee - pitch),
    }
    for name, value in turns.items():
        local_rotation[:, skeleton.body_names.index(name)] = value.numpy()


def _limbs(gait: Gait, side: str, sign: float, phase: FloatArray) -> dict[str, Tensor]:
    """Return the rotations of one side's limbs; `sign` is -1 on the right and +1 on the left."""

    def angle(table: tuple[float, ...]) -> FloatArray:
        return PeriodicCurve.from_degrees(table)(phase)

    def constant(degrees: float) -> FloatArray:
        return np.full_like(phase, np.radians(degrees))

    # Positive turns about y swing a hanging limb backwards. Only knee flexion is positive.
    return {
        f"{side}_thigh": turn("y", -angle(gait.hip_flexion)),
        f"{side}_shin": turn("y", angle(gait.knee_flexion)),
        f"{side}_foot": turn("y", -angle(gait.ankle_dorsiflexion)),
        f"{side}_upper_arm": compose(
            turn("y", -angle(gait.shoulder_flexion)),
            turn("x", sign * constant(gait.shoulder_abduction_deg)),
            turn("z", -sign * constant(gait.shoulder_rotation_deg)),
        ),
        f"{side}_lower_arm": turn("y", -angle(gait.elbow_flexion)),
    }


def turn(axis: str, angle: FloatArray) -> Tensor:
    """Return the rotations (n, 4) by angles (n) in rad about a coordinate axis."""
    angles = torch.from_numpy(np.asarray(angle, dtype=np.float64))
    direction = torch.tensor(_AXES[axis], dtype=torch.float64)
    return rotations.quat_from_angle_axis(angles, direction.expand(len(angles), 3))


def compose(first: Tensor, *rest: Tensor) -> Tensor:
    """Return the product of rotations (n, 4); each turns about the axes after the previous turn."""
    product = first
    for factor in rest:
        product = rotations.quat_mul(product, factor)
    return product
