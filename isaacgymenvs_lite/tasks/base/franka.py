"""The Franka Panda arm of FrankaCabinet and FrankaCubeStack: names, joints and drives."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.assets import asset_path
from isaacgymenvs_lite.tasks.base.drives import integrate_drives_implicitly
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.scenes import (
    ARM_BITS,
    PositionDrive,
    add_position_drive,
    ensure_frame,
    find_body,
    find_joint,
    limit_speed,
    prepare_robot,
    topmost,
)
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig, TaskConfig

NUM_ARM_JOINTS = 7
NUM_JOINTS = 9
ARM_EFFORTS_NM = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
_MAX_SPEEDS_RAD_S = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
# Inertia of the motors as seen behind their gears (kg m^2), from MuJoCo's menagerie.
_ARMATURE = 0.1
# IsaacGymEnvs' FrankaCabinet has 1e6 N/m. With 5000 N/m, as in FrankaCubeStack, the fingers are
# stable at this project's time steps.
_FINGER_DRIVE = PositionDrive(stiffness=5000.0, damping=100.0, effort=200.0)

_ARM_JOINTS = tuple(
    (f"panda_joint{i}", f"joint{i}", f"fr3_joint{i}") for i in range(1, 1 + NUM_ARM_JOINTS)
)
_FINGER_JOINTS = tuple(
    (f"panda_finger_joint{i}", f"finger_joint{i}", f"fr3_finger_joint{i}") for i in (1, 2)
)
LINK7 = ("panda_link7", "link7", "fr3_link7")
_HAND = ("panda_hand", "hand", "fr3_hand")
_LEFT_FINGER = ("panda_leftfinger", "left_finger", "fr3_leftfinger")
_RIGHT_FINGER = ("panda_rightfinger", "right_finger", "fr3_rightfinger")
# The hand's pose in the frame of link 7, for files in which the hand is a part of link 7.
_HAND_M, _HAND_ROT_WXYZ = (0.0, 0.0, 0.107), (0.9238795, 0.0, 0.0, -0.3826834)
_GRIP_SITE_M = (0.0, 0.0, 0.1025)  # in the frame of the hand


@dataclass(frozen=True)
class FrankaAssetConfig(AssetConfig):
    """`task.env.asset`."""

    asset_file_name_franka: str = setting("", key="assetFileNameFranka")


@dataclass(frozen=True, kw_only=True)
class FrankaConfig(TaskConfig):
    """Keys of `task.env` that both tasks share."""

    asset: FrankaAssetConfig = field(default_factory=FrankaAssetConfig)


def _tip_pos(joint: mujoco.MjsJoint) -> tuple[float, float, float]:
    """Return the fingertip's position (m) in the frame of the finger that `joint` moves."""
    return (0.0, 0.0015 * float(joint.axis[1]), 0.0441)


class FrankaTask(MjcfTask):
    """N arms with nine joints: seven hinges (rad) and the two fingers (m)."""

    default_asset = "mjcf/franka_panda.xml"
    published_assets = (
        "urdf/franka_description/robots/franka_panda.urdf",
        "urdf/franka_description/robots/franka_panda_gripper.urdf",
    )
    actor_name = "franka"
    max_physics_step_s = 0.0085
    placing_joints: tuple[str, ...] = ()
    """Joints that move the base or furniture to a random place, see `add_placing_joints`."""
    base_pos: ClassVar[tuple[float, float, float]]
    base_quat_wxyz: ClassVar[tuple[float, float, float, float]]

    def asset_path(self) -> Path:
        """Return the path of the arm's file, which `assetFileName` or `assetFileNameFranka` names.

        `assetFileName` has the higher priority.
        """
        asset = self.env_cfg.asset
        key = "assetFileName" if asset.asset_file_name else "assetFileNameFranka"
        name = asset.asset_file_name or asset.asset_file_name_franka
        return asset_path(
            AssetConfig(name, asset.asset_root),
            self.default_asset,
            self.published_assets,
            f"task.env.asset.{key}",
        )

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Place the arm, give its joints drives, and furnish the scene."""
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        link7 = find_body(spec, LINK7)
        hand = ensure_frame(spec, _HAND, link7, _HAND_M, _HAND_ROT_WXYZ)
        root = topmost(link7)
        root.pos, root.quat = self.base_pos, self.base_quat_wxyz
        prepare_robot(spec, root, ARM_BITS)
        fingers = [find_joint(spec, names) for names in _FINGER_JOINTS]
        left, right = (find_body(spec, names) for names in (_LEFT_FINGER, _RIGHT_FINGER))
        tips = [
            ensure_frame(spec, (f"panda_{side}finger_tip",), finger, _tip_pos(joint))
            for side, finger, joint in zip(("left", "right"), (left, right), fingers, strict=True)
        ]
        grip = ensure_frame(spec, ("panda_grip_site",), hand, _GRIP_SITE_M)
        parts = (link7, hand, left, right, *tips, grip)
        names = ("link7", "hand", "left", "right", "left_tip", "right_tip", "grip")
        self.body_names_of_franka = {n: p.name for n, p in zip(names, parts, strict=True)}
        arm = [find_joint(spec, names) for names in _ARM_JOINTS]
        for joint, effort, speed in zip(arm, ARM_EFFORTS_NM, _MAX_SPEEDS_RAD_S, strict=True):
            limit_speed(joint, effort, speed)
            joint.armature = _ARMATURE
        for joint in fingers:
            joint.damping[:] = 0.0
            joint.armature = 0.0
        self.joint_names = tuple(joint.name for joint in (*arm, *fingers))
        self.add_arm_drives(spec, arm)
        for joint in fingers:
            add_position_drive(spec, joint, _FINGER_DRIVE)
        integrate_drives_implicitly(spec, self.sim_cfg.dt / self.sim_cfg.substeps)
        self.furnish(spec)

    def add_arm_drives(self, spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint]) -> None:
        """Add actuators for the seven joints of the arm, in their order."""
        raise NotImplementedError

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add furniture and objects to the scene."""
        raise NotImplementedError

    def create_sim(self) -> None:
        """Create the simulations and look up joints and bodies."""
        super().create_sim()
        sim = self.simulation
        self._dofs, self.lower_limits, self.upper_limits = self.find_joints(self.joint_names)
        self._placing_dofs = [sim.dof_names.index(name) for name in self.placing_joints]
        self._bodies = {
            part: sim.body_names.index(name) for part, name in self.body_names_of_franka.items()
        }

    def joint_pos(self) -> Tensor:
        """Return the positions (N, 9) of the arm's joints (rad) and the fingers (m)."""
        return self.simulation.dof_pos.index_select(1, self._dofs)

    def joint_vel(self) -> Tensor:
        """Return the velocities (N, 9) of the arm's joints (rad/s) and the fingers (m/s)."""
        return self.simulation.dof_vel.index_select(1, self._dofs)

    def pos_w(self, part: str) -> Tensor:
        """Return the positions (N, 3) in m of a part of the arm."""
        return self.simulation.body_pos[:, self._bodies[part]]

    def rot_w(self, part: str) -> Tensor:
        """Return the rotations (N, 4) xyzw of a part of the arm."""
        return self.simulation.body_rot[:, self._bodies[part]]

    def write_joints(self, env_ids: Tensor, pos: Tensor, places: Tensor) -> None:
        """Put the arms of environments (n,) at joint positions (n, 9), at rest.

        `places` (n, k) are positions of the k `placing_joints`. Other joints of furniture return to
        zero, and objects to their poses in the model.
        """
        sim = self.simulation
        dof_pos = torch.zeros(len(env_ids), len(sim.dof_names), device=self.device)
        dof_pos[:, self._dofs] = pos
        dof_pos[:, self._placing_dofs] = places
        root = torch.zeros(len(env_ids), 13, device=self.device)
        sim.write_state(env_ids, root, dof_pos, torch.zeros_like(dof_pos))
