"""The names of IsaacGymEnvs' `tasks.amp.utils_amp.motion_lib`."""

from __future__ import annotations

from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import DOF_BODY_IDS, DOF_OFFSETS

__all__ = ["DOF_BODY_IDS", "DOF_OFFSETS", "MotionLib"]
