"""Settings of a robot in YAML; all keys have defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.schema import read_section, setting

_MAX_GAIN = 1e6


@dataclass(frozen=True, kw_only=True)
class DriveSettings:
    """Position drives of the joints that match a pattern; this project chooses null values."""

    kp: float | None = setting(None, minimum=0, maximum=_MAX_GAIN)
    """Stiffness in Nm/rad."""
    kd: float | None = setting(None, minimum=0, maximum=_MAX_GAIN)
    """Damping in Nm s/rad."""
    effort: float | None = setting(None, above=0, maximum=_MAX_GAIN)
    """Largest torque in Nm, in both directions."""
    armature: float | None = setting(None, minimum=0, maximum=_MAX_GAIN)
    """Inertia of the rotor at the joint in kg m^2; null takes it from the file, else estimates
    it."""


@dataclass(frozen=True, kw_only=True)
class RobotSettings:
    """The section of a robot."""

    drives: Mapping[str, Any] | None = None
    """Maps patterns of joint names (`*_knee*`) to `DriveSettings`; the first match counts."""
    key_bodies: tuple[str, ...] = setting((), key="keyBodies")
    """Names or patterns of the bodies whose positions are observed; () selects the ends of
    limbs."""
    contact_bodies: tuple[str, ...] = setting((), key="contactBodies")
    """Names or patterns of the bodies that may touch the floor. The empty tuple selects the bodies
    that touch the floor in the start pose."""
    start_pose: Any = setting(None, key="startPose")
    """Name of a keyframe, or a mapping from names or patterns of hinges to angles (rad). null
    selects the keyframe `home` or `stand`, else the first keyframe, else the angle nearest to zero
    within each joint's limits."""
    start_rotation: tuple[float, ...] | None = setting(None, key="startRotation", length=4)
    """Orientation of the base, xyzw; null selects the orientation in the keyframe or the file."""
    start_height: float | None = setting(None, key="startHeight")
    """Height of the base's origin in m; null puts the robot on the floor."""


def read_drives(drives: Mapping[str, Any] | None, where: str) -> dict[str, DriveSettings]:
    """Return the settings of each pattern."""
    return {
        str(pattern): read_section(DriveSettings, values, f"{where}.{pattern}", complete=True)
        for pattern, values in (drives or {}).items()
    }
