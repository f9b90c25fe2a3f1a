"""What a user says about a robot in YAML; all keys have sensible values without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.schema import read_section, setting

_MAX_GAIN = 1e6


@dataclass(frozen=True, kw_only=True)
class DriveSettings:
    """Position drives of the joints that a pattern matches; null is this project's choice."""

    kp: float | None = setting(None, minimum=0, maximum=_MAX_GAIN)
    """Stiffness in Nm/rad."""
    kd: float | None = setting(None, minimum=0, maximum=_MAX_GAIN)
    """Damping in Nm s/rad."""
    effort: float | None = setting(None, above=0, maximum=_MAX_GAIN)
    """Largest torque in Nm, in both directions."""
    armature: float | None = setting(None, minimum=0, maximum=_MAX_GAIN)
    """Inertia of the motor's rotor at the joint in kg m^2; null: the file's, else by the effort."""


@dataclass(frozen=True, kw_only=True)
class RobotSettings:
    """A section about a robot."""

    drives: Mapping[str, Any] | None = None
    """Patterns of joint names (`*_knee*`) to `DriveSettings`; the first that matches counts."""
    key_bodies: tuple[str, ...] = setting((), key="keyBodies")
    """Bodies whose positions are observed, names or patterns; () for the ends of the limbs."""
    contact_bodies: tuple[str, ...] = setting((), key="contactBodies")
    """Bodies that may touch the floor, names or patterns; () for what does in the start pose."""
    start_pose: Any = setting(None, key="startPose")
    """Name of a keyframe, or angles of hinges (rad) by names or patterns; null for the keyframe
    `home` or `stand`, the first one, or zero within the limits."""
    start_rotation: tuple[float, ...] | None = setting(None, key="startRotation", length=4)
    """Orientation of the base, xyzw; null for the keyframe's or the file's."""
    start_height: float | None = setting(None, key="startHeight")
    """Height of the base's origin in m; null to put the robot on the floor."""


def read_drives(drives: Mapping[str, Any] | None, where: str) -> dict[str, DriveSettings]:
    """Return the settings of each pattern."""
    return {
        str(pattern): read_section(DriveSettings, values, f"{where}.{pattern}", complete=True)
        for pattern, values in (drives or {}).items()
    }
