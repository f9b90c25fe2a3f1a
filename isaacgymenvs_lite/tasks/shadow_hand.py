"""ShadowHand: the Shadow hand turns a block, an egg or a pen in its palm, as in IsaacGymEnvs.

The module `base.in_hand` has formulas and further differences. The joints have no friction
(published: 0.001 Nm), which makes the physics faster.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import mujoco

from isaacgymenvs_lite.tasks.base.in_hand import (
    EGG,
    FULL,
    FULL_NO_VEL,
    FULL_STATE,
    OPENAI,
    PEN,
    HeldObject,
    InHandTask,
    block,
    compute_hand_reward,
    randomize_rotation,
    randomize_rotation_pen,
)
from isaacgymenvs_lite.tasks.base.scenes import HAND_WITHOUT_SELF_CONTACT_BITS, Names, PositionDrive

__all__ = ["ShadowHand", "compute_hand_reward", "randomize_rotation", "randomize_rotation_pen"]

_JOINTS = (
    *("WRJ1", "WRJ0", "FFJ3", "FFJ2", "FFJ1", "FFJ0", "MFJ3", "MFJ2", "MFJ1", "MFJ0"),
    *("RFJ3", "RFJ2", "RFJ1", "RFJ0", "LFJ4", "LFJ3", "LFJ2", "LFJ1", "LFJ0"),
    *("THJ4", "THJ3", "THJ2", "THJ1", "THJ0"),
)
_EFFORTS_NM = {
    **{"WRJ1": 4.785, "WRJ0": 2.175, "LFJ4": 0.9},
    **{f"{finger}J{i}": 0.9 for finger in ("FF", "MF", "RF", "LF") for i in (3, 2)},
    **{f"{finger}J1": 0.7245 for finger in ("FF", "MF", "RF", "LF")},
    **{"THJ4": 2.3722, "THJ3": 1.45, "THJ2": 0.99, "THJ1": 0.99, "THJ0": 0.81},
}
_STIFFNESS, _WRIST_STIFFNESS = 1.0, 5.0  # Nm/rad
_DAMPING, _WRIST_DAMPING = 0.1, 0.5  # Nm s/rad
_ARMATURE, _WRIST_ARMATURE = 0.001, 0.005  # kg m^2
# A tendon couples the last two joints of each finger except the thumb: 0.00705 J0 - 0.00805 J1 (m).
_TENDON_COEFFICIENTS = {"J0": 0.00705, "J1": -0.00805}
_TENDON_LIMIT_M = 0.001
_TENDON_DAMPING = 0.1  # N s/m


def _names(joint: str) -> Names:
    """Return the names of a joint; Shadow's own files and MuJoCo's menagerie count from 1."""
    return (f"robot0:{joint}", joint, f"rh_{joint[:-1]}{int(joint[-1]) + 1}")


class ShadowHand(InHandTask):
    """N Shadow hands with 20 actions and 211, 157, 77 or 42 observations."""

    default_asset = "mjcf/shadow_hand.xml"
    published_assets = ("mjcf/open_ai_assets/hand/shadow_hand.xml",)
    joints = tuple(_names(joint) for joint in _JOINTS)
    drives: ClassVar[dict[int, PositionDrive]] = {
        number: PositionDrive(
            *((_WRIST_STIFFNESS, _WRIST_DAMPING) if "WR" in joint else (_STIFFNESS, _DAMPING)),
            _EFFORTS_NM[joint],
        )
        for number, joint in enumerate(_JOINTS)
        if joint in _EFFORTS_NM
    }
    base_joints = tuple(_JOINTS.index(joint) for joint in ("FFJ3", "MFJ3", "RFJ3", "LFJ4", "THJ4"))
    fingertips = tuple(
        (f"robot0:{finger}distal", f"{finger}distal", f"rh_{finger}distal")
        for finger in ("ff", "mf", "rf", "lf", "th")
    )
    bits = HAND_WITHOUT_SELF_CONTACT_BITS
    objects: ClassVar[dict[str, HeldObject]] = {
        "block": block(0.05, 567.0, 0.10),
        "egg": EGG,
        "pen": PEN,
    }
    start_offset_m = (0.0, -0.39)
    observation_types = (OPENAI, FULL_NO_VEL, FULL, FULL_STATE)

    def change_joints(self, spec: mujoco.MjSpec, joints: Sequence[mujoco.MjsJoint]) -> None:
        """Set dampings and armatures, and couple the last two joints of the fingers."""
        for name, joint in zip(_JOINTS, joints, strict=True):
            # The drives damp the other joints.
            joint.damping[:] = (0.0 if name in _EFFORTS_NM else _DAMPING, 0.0, 0.0)
            joint.armature = _WRIST_ARMATURE if name.startswith("WR") else _ARMATURE
            joint.frictionloss = 0.0
        for finger in ("FF", "MF", "RF", "LF"):
            tendon = spec.add_tendon(name=f"{finger}T1", limited=True)
            tendon.range[:] = (-_TENDON_LIMIT_M, _TENDON_LIMIT_M)
            tendon.damping[:] = (_TENDON_DAMPING, 0.0, 0.0)
            for joint, coefficient in _TENDON_COEFFICIENTS.items():
                tendon.wrap_joint(joints[_JOINTS.index(finger + joint)].name, coefficient)
