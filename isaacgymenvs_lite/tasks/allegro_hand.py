"""AllegroHand: the Allegro hand turns a block, an egg or a pen in its palm, as in IsaacGymEnvs.

The module `base.in_hand` has formulas and further differences. In IsaacGymEnvs the observed torques
of the joints are zero; here they are the torques of drives and dampers. The joints have no
friction: PhysX's coefficient has no counterpart in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import mujoco

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.in_hand import (
    EGG,
    FULL,
    FULL_NO_VEL,
    FULL_STATE,
    PEN,
    HandConfig,
    HeldObject,
    InHandTask,
    block,
    compute_hand_reward,
    randomize_rotation,
    randomize_rotation_pen,
)
from isaacgymenvs_lite.tasks.base.scenes import PositionDrive, limit_speed

__all__ = ["AllegroHand", "compute_hand_reward", "randomize_rotation", "randomize_rotation_pen"]

# The published names and those of MuJoCo's menagerie.
_FINGERS = {"index": "ff", "middle": "mf", "ring": "rf", "thumb": "th"}
_DRIVE = PositionDrive(stiffness=3.0, damping=0.1, effort=0.5)
_ARMATURE = 0.001  # kg m^2
_MAX_SPEED_RAD_S = 6.283


@dataclass(frozen=True, kw_only=True)
class AllegroHandConfig(HandConfig):
    """`task.env` of AllegroHand."""

    start_object_pose_dy: float = setting(-0.19, key="startObjectPoseDY")  # no effect
    start_object_pose_dz: float = setting(0.06, key="startObjectPoseDZ")  # no effect


class AllegroHand(InHandTask):
    """N Allegro hands with 16 actions and 88, 72 or 50 observations."""

    settings_class = AllegroHandConfig
    default_asset = "mjcf/allegro_hand.xml"
    published_assets = (
        "urdf/kuka_allegro_description/allegro_touch_sensor.urdf",
        "urdf/kuka_allegro_description/allegro.urdf",
    )
    joints = tuple(
        (f"{finger}_joint_{i}", f"{short}j{i}")
        for finger, short in _FINGERS.items()
        for i in range(4)
    )
    drives = dict.fromkeys(range(16), _DRIVE)
    base_joints = (0, 1, 4, 5, 8, 9, 12)
    objects: ClassVar[dict[str, HeldObject]] = {
        "block": block(0.065, 400.0, 0.06),
        "egg": EGG._replace(start_above_hand_m=0.06),
        "pen": PEN,
    }
    start_offset_m = (0.0, -0.2)
    observation_types = (FULL_NO_VEL, FULL, FULL_STATE)

    def change_joints(self, spec: mujoco.MjSpec, joints: Sequence[mujoco.MjsJoint]) -> None:
        """Set armatures, and a drag that limits the speed."""
        for joint in joints:
            limit_speed(joint, _DRIVE.effort, _MAX_SPEED_RAD_S)
            joint.armature = _ARMATURE
            joint.frictionloss = 0.0
