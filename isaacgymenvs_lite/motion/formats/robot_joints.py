"""Orders of joints in the clip files of Unitree's robots.

The README of the data set unitreerobotics/LAFAN1_Retargeting_Dataset (Hugging Face) lists them;
they are the orders of the joints in the robots' URDF and MJCF files.
"""

from __future__ import annotations

import itertools

_ARM_7 = (
    *("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),
    *("wrist_roll", "wrist_pitch", "wrist_yaw"),
)


def _sides(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{side}_{joint}_joint" for side in ("left", "right") for joint in joints)


G1_29 = (
    *_sides(("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")),
    *("waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint"),
    *_sides(_ARM_7),
)
H1_2_27 = (
    *_sides(("hip_yaw", "hip_pitch", "hip_roll", "knee", "ankle_pitch", "ankle_roll")),
    "torso_joint",
    *_sides(_ARM_7),
)
H1_19 = (
    *_sides(("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")),
    "torso_joint",
    *_sides(_ARM_7[:4]),
)
BY_NUMBER = {len(names): names for names in (G1_29, H1_2_27, H1_19)}
"""Names by the number of joints: a file without a header says no more."""


_WAIST = ("",) * 3  # the arms begin three levels below the root
_LEVELS = itertools.zip_longest(
    *(G1_29[:6], G1_29[6:12], G1_29[12:15], _WAIST + G1_29[15:22], _WAIST + G1_29[22:]),
    fillvalue="",
)
G1_29_BREADTH_FIRST = tuple(joint for level in _LEVELS for joint in level if joint)
"""The order of Isaac Lab, which numbers bodies and joints level by level."""
