"""Orders of joints in the clip files of Unitree's robots.

The README of the data set unitreerobotics/LAFAN1_Retargeting_Dataset (Hugging Face) lists them;
they are the orders of the joints in the robots' URDF and MJCF files.
"""

from __future__ import annotations

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


def _by_depth(chains: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """Return the joints of chains level by level; () is the gap above a chain's first joint."""
    depth = max(map(len, chains))
    return tuple(chain[i] for i in range(depth) for chain in chains if i < len(chain) and chain[i])


G1_29_BREADTH_FIRST = _by_depth(
    (
        G1_29[:6],
        G1_29[6:12],
        G1_29[12:15],
        ("", "", "", *G1_29[15:22]),
        ("", "", "", *G1_29[22:29]),
    )
)
"""The order of Isaac Lab, which numbers bodies and joints level by level."""
