"""FrankaCabinet: an arm opens the top drawer of a cabinet, as in IsaacGymEnvs.

The task keeps two quirks: an episode ends as soon as the drawer is open, and the reward of a finger
behind the handle is -1 even in the step that opens the drawer.

The published reward pays for each step with a drawer that is almost open, and an open drawer ends
the episode, so that the best policy holds the drawer just short of open. The key `openBonus`, which
is not published, pays for the last step.

Differences from IsaacGymEnvs: all entries of an episode's first observation are current; there some
are from the previous episode. Each episode places the cabinet anew (`startPositionNoise`). The
lower drawer is light (assets/mjcf/sektion_cabinet.xml), and the fingers' drives are softer
(`base.franka`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.assets import asset_path, read_spec
from isaacgymenvs_lite.tasks.base.franka import (
    ARM_EFFORTS_NM,
    NUM_ARM_JOINTS,
    NUM_JOINTS,
    FrankaAssetConfig,
    FrankaConfig,
    FrankaTask,
)
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms, replace_where
from isaacgymenvs_lite.tasks.base.scenes import (
    FURNITURE_BITS,
    PositionDrive,
    add_object,
    add_placing_joints,
    add_position_drive,
    find_body,
    find_joint,
    remove_controls,
    set_bits,
    subtree,
    topmost,
)
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig
from isaacgymenvs_lite.utils.rotations import length, quat_apply, quat_mul
from isaacgymenvs_lite.utils.scaling import unscale

_ARM_STIFFNESS, _ARM_DAMPING = 400.0, 80.0
_SPEED_SCALES = (*(1.0,) * NUM_ARM_JOINTS, 0.1, 0.1)
_DEFAULT_POS = (1.157, -1.066, -0.155, -2.239, -1.841, 1.003, 0.469, 0.035, 0.035)
_START_NOISE = 0.125  # rad or m, of every joint
# The grasp pose in the frame of link 7: between the fingers, 4 cm along y.
_HAND_GRASP_M = (0.0, 0.04, 0.1654)
_HAND_GRASP_ROT = (0.0, 0.0, -math.sin(math.pi / 8), math.cos(math.pi / 8))
_DRAWER_GRASP_M = (0.3, 0.01, 0.0)  # in the frame of the top drawer

_CABINET = "mjcf/sektion_cabinet.xml"
_PUBLISHED_CABINETS = ("urdf/sektion_cabinet_model/urdf/sektion_cabinet_2.urdf",)
_CABINET_POS_M = (0.0, 0.0, 0.4)
_PREFIX = "cabinet_"
_PROP_SIZE_M, _PROP_SPACING_M, _PROP_DENSITY = 0.08, 0.09, 400.0

_GRASPED_M = 0.02
_OPEN_M = 0.39
_BEHIND_HANDLE_M = 0.04
_FINGER_TRAVEL_M = 0.04


@dataclass(frozen=True)
class FrankaCabinetAssetConfig(FrankaAssetConfig):
    """`task.env.asset`."""

    asset_file_name_cabinet: str = setting("", key="assetFileNameCabinet")


@dataclass(frozen=True, kw_only=True)
class FrankaCabinetConfig(FrankaConfig):
    """`task.env` of FrankaCabinet."""

    asset: FrankaCabinetAssetConfig = field(default_factory=FrankaCabinetAssetConfig)
    episode_length: int = setting(500, key="episodeLength", minimum=2)
    num_props: int = setting(16, key="numProps", minimum=0, maximum=64)
    start_position_noise: float = setting(0.0, key="startPositionNoise", minimum=0)  # m
    start_rotation_noise: float = setting(0.0, key="startRotationNoise")  # no effect
    aggregate_mode: int = setting(3, key="aggregateMode")  # no effect
    action_scale: float = setting(7.5, key="actionScale", minimum=0)  # rad/s or m/s
    dof_velocity_scale: float = setting(0.1, key="dofVelocityScale")
    dist_reward_scale: float = setting(2.0, key="distRewardScale")
    rot_reward_scale: float = setting(0.5, key="rotRewardScale")
    around_handle_reward_scale: float = setting(0.25, key="aroundHandleRewardScale")
    open_reward_scale: float = setting(7.5, key="openRewardScale")
    finger_dist_reward_scale: float = setting(5.0, key="fingerDistRewardScale")
    action_penalty_scale: float = setting(0.01, key="actionPenaltyScale")
    open_bonus: float = setting(0.0, key="openBonus")


def compute_franka_observations(
    dof_pos: Tensor,
    dof_vel: Tensor,
    lower: Tensor,
    upper: Tensor,
    to_target: Tensor,
    drawer_pos: Tensor,
    drawer_vel: Tensor,
    dof_velocity_scale: float,
) -> Tensor:
    """Return the observations (N, 23).

    Args:
        dof_pos: (N, 9) rad and m.
        dof_vel: (N, 9) rad/s and m/s.
        lower: (9,) lower limits of the joints.
        upper: (9,) upper limits.
        to_target: (N, 3) m, vector from the hand's grasp point to the drawer's.
        drawer_pos: (N,) m, opening of the top drawer.
        drawer_vel: (N,) m/s.
        dof_velocity_scale: factor of `dof_vel`.
    """
    drawer = torch.stack((drawer_pos, drawer_vel), dim=-1)
    scaled = unscale(dof_pos, lower, upper)
    return torch.cat((scaled, dof_vel * dof_velocity_scale, to_target, drawer), dim=-1)


def compute_franka_reward(
    actions: Tensor,
    drawer_opening: Tensor,
    hand_grasp_pos: Tensor,
    drawer_grasp_pos: Tensor,
    hand_grasp_rot: Tensor,
    drawer_grasp_rot: Tensor,
    left_finger_pos: Tensor,
    right_finger_pos: Tensor,
    cfg: FrankaCabinetConfig,
) -> Terms:
    """Return the reward terms (N,).

    Args:
        actions: (N, 9).
        drawer_opening: (N,) m.
        hand_grasp_pos: (N, 3) m, in the world frame like all poses.
        drawer_grasp_pos: (N, 3) m.
        hand_grasp_rot: (N, 4) xyzw; z points forward, y up.
        drawer_grasp_rot: (N, 4) xyzw; -x points into the drawer, z up.
        left_finger_pos: (N, 3) m.
        right_finger_pos: (N, 3) m.
        cfg: the reward scales.
    """
    distance = length(hand_grasp_pos - drawer_grasp_pos)
    near = (1.0 / (1.0 + distance.square())).square()
    near = torch.where(distance <= _GRASPED_M, 2.0 * near, near)
    forward = _dot(_axis(hand_grasp_rot, 2), -_axis(drawer_grasp_rot, 0))
    up = _dot(_axis(hand_grasp_rot, 1), _axis(drawer_grasp_rot, 2))
    aligned = 0.5 * (forward.sign() * forward.square() + up.sign() * up.square())
    left = left_finger_pos[:, 2] - drawer_grasp_pos[:, 2]
    right = right_finger_pos[:, 2] - drawer_grasp_pos[:, 2]
    is_around = (left > 0.0) & (right < 0.0)
    around = 0.5 * is_around
    closed = (2.0 * _FINGER_TRAVEL_M - left.abs() - right.abs()) * is_around
    stages = (
        0.5 * (drawer_opening > 0.01)
        + around * (drawer_opening > 0.2)
        + 2.0 * around * (drawer_opening > _OPEN_M)
    )
    terms = {
        "distance": cfg.dist_reward_scale * near,
        "rotation": cfg.rot_reward_scale * aligned,
        "around_handle": cfg.around_handle_reward_scale * around,
        "open": cfg.open_reward_scale * (drawer_opening * around + drawer_opening),
        "finger_distance": cfg.finger_dist_reward_scale * closed,
        "action": -cfg.action_penalty_scale * actions.square().sum(-1),
        "stages": stages,
        "bonus": cfg.open_bonus * (drawer_opening > _OPEN_M),
    }
    fingers_x = torch.minimum(left_finger_pos[:, 0], right_finger_pos[:, 0])
    is_behind = fingers_x < drawer_grasp_pos[:, 0] - _BEHIND_HANDLE_M
    return replace_where(terms, is_behind, "behind_handle", -1.0)


def compute_grasp_transforms(
    hand_rot: Tensor, hand_pos: Tensor, drawer_rot: Tensor, drawer_pos: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return rotation (N, 4) and position (N, 3) of the hand's grasp pose, then the drawer's.

    The arguments are the poses of link 7 and of the top drawer: rotations (N, 4) xyzw and positions
    (N, 3) m. The drawer's grasp pose has the drawer's rotation.
    """
    local_rot, local_pos, drawer_local_pos = (
        hand_pos.new_tensor(values).expand(len(hand_pos), -1)
        for values in (_HAND_GRASP_ROT, _HAND_GRASP_M, _DRAWER_GRASP_M)
    )
    return (
        quat_mul(hand_rot, local_rot),
        hand_pos + quat_apply(hand_rot, local_pos),
        drawer_rot,
        drawer_pos + quat_apply(drawer_rot, drawer_local_pos),
    )


def _axis(rot: Tensor, index: int) -> Tensor:
    """Return an axis (N, 3) of the frames with rotations (N, 4) xyzw."""
    return quat_apply(rot, torch.eye(3, device=rot.device)[index].expand(len(rot), 3))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


class FrankaCabinet(FrankaTask):
    """N arms with cabinets, 23 observations and 9 actions.

    Each action is the speed at which the position target of a joint moves.
    """

    settings_class = FrankaCabinetConfig
    num_observations = 23
    num_actions = NUM_JOINTS
    base_pos = (1.0, 0.0, 0.0)
    base_quat_wxyz = (0.0, 0.0, 0.0, 1.0)

    def add_arm_drives(self, spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint]) -> None:
        """Add position drives."""
        for joint, effort in zip(joints, ARM_EFFORTS_NM, strict=True):
            drive = PositionDrive(_ARM_STIFFNESS, _ARM_DAMPING, effort)
            add_position_drive(spec, joint, drive)

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add the cabinet, and loose boxes in its top drawer."""
        asset = self.env_cfg.asset
        path = asset_path(
            AssetConfig(asset.asset_file_name_cabinet, asset.asset_root),
            _CABINET,
            _PUBLISHED_CABINETS,
            "task.env.asset.assetFileNameCabinet",
        )
        cabinet = read_spec(path, _CABINET)
        drawer = find_body(cabinet, ("drawer_top",))
        self._drawer_name = _PREFIX + drawer.name
        self._drawer_joint = _PREFIX + find_joint(cabinet, ("drawer_top_joint",)).name
        remove_controls(cabinet)
        for geom in cabinet.worldbody.geoms:  # a floor of a user's file
            cabinet.delete(geom)
        root = topmost(drawer)
        for body in subtree(root):
            set_bits(body.geoms, FURNITURE_BITS)
        spec.attach(cabinet, prefix=_PREFIX, frame=spec.worldbody.add_frame(pos=_CABINET_POS_M))
        if self.env_cfg.start_position_noise > 0:
            self.placing_joints = add_placing_joints(root, "xyz")
        per_row = math.ceil(math.sqrt(self.env_cfg.num_props))
        first = -0.5 * _PROP_SPACING_M * (per_row - 1)
        drawer_pos = [sum(axis) for axis in zip(_CABINET_POS_M, drawer.pos, strict=True)]
        for number in range(self.env_cfg.num_props):
            row, column = divmod(number, per_row)
            offset = (first + _PROP_SPACING_M * column, first + _PROP_SPACING_M * row, 0.0)
            pos = [sum(axis) for axis in zip(drawer_pos, offset, strict=True)]
            size = (0.5 * _PROP_SIZE_M,) * 3
            add_object(spec, f"prop_{number}", size, pos, _PROP_DENSITY)

    def create_sim(self) -> None:
        """Create the simulations and look up the drawer."""
        super().create_sim()
        self._drawer = self.simulation.body_names.index(self._drawer_name)
        self._drawer_dof = self.simulation.dof_names.index(self._drawer_joint)
        self._speeds = torch.tensor(_SPEED_SCALES, device=self.device) * self.env_cfg.action_scale
        self._default_pos = torch.tensor(_DEFAULT_POS, device=self.device)

    def allocate_buffers(self) -> None:
        """Add the position targets."""
        super().allocate_buffers()
        self.targets = self._default_pos.repeat(self.num_envs, 1)  # (N, 9) rad and m

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Move the position targets (N, 9) by the actions, and return them."""
        self.targets += actions * (self._speeds * self.sim_dt_s)
        return self.targets.clamp_(self.lower_limits, self.upper_limits)

    def update_state(self) -> None:
        """Compute the grasp poses."""
        sim = self.simulation
        self.hand_grasp_rot, self.hand_grasp_pos, self.drawer_grasp_rot, self.drawer_grasp_pos = (
            compute_grasp_transforms(
                self.rot_w("link7"),
                self.pos_w("link7"),
                sim.body_rot[:, self._drawer],
                sim.body_pos[:, self._drawer],
            )
        )

    def observation_groups(self) -> dict[str, int]:
        """See `compute_franka_observations`."""
        return {"dof_pos": 9, "dof_vel": 9, "to_target": 3, "drawer_pos": 1, "drawer_vel": 1}

    def compute_obs(self) -> Tensor:
        """See `compute_franka_observations`."""
        sim = self.simulation
        return compute_franka_observations(
            self.joint_pos(),
            self.joint_vel(),
            self.lower_limits,
            self.upper_limits,
            self.drawer_grasp_pos - self.hand_grasp_pos,
            sim.dof_pos[:, self._drawer_dof],
            sim.dof_vel[:, self._drawer_dof],
            self.env_cfg.dof_velocity_scale,
        )

    def compute_obs_of(self, env_ids: Tensor) -> Tensor:
        """Return the observations (n, 23) of environments (n,) that start an episode."""
        self.update_state()
        return super().compute_obs_of(env_ids)

    def compute_reward_terms(self) -> Terms:
        """See `compute_franka_reward`."""
        return compute_franka_reward(
            self.actions,
            self.simulation.dof_pos[:, self._drawer_dof],
            self.hand_grasp_pos,
            self.drawer_grasp_pos,
            self.hand_grasp_rot,
            self.drawer_grasp_rot,
            self.pos_w("left"),
            self.pos_w("right"),
            self.env_cfg,
        )

    def compute_reached(self) -> Tensor:
        """Return where (N,) the drawer is open."""
        return self.simulation.dof_pos[:, self._drawer_dof] > _OPEN_M

    def episode_successes(self) -> dict[str, Tensor]:
        """Return whether the drawer is open."""
        return {"drawer_open": self.compute_reached()}

    def reset_state(self, env_ids: Tensor) -> None:
        """Draw joint positions near the default pose, and close the cabinet."""
        noise = uniform(env_ids, -_START_NOISE, _START_NOISE, (NUM_JOINTS,))
        pos = (self._default_pos + noise).clamp(self.lower_limits, self.upper_limits)
        x, y, z = (self.env_cfg.start_position_noise * uniform(env_ids, 0.0, 1.0, (3,))).unbind(-1)
        half = 0.5 * self.env_cfg.start_position_noise
        places = torch.stack((x - half, y - half, 0.5 * z), dim=-1)
        self.write_joints(env_ids, pos, places[:, : len(self.placing_joints)])
        if self.placing_joints and self.simulation.object_names:
            props = self.simulation.object_states.index_select(0, env_ids).clone()
            props[..., :3] += places[:, None]
            numbers = torch.arange(props.shape[1], device=self.device)
            self.simulation.write_object_states(env_ids, numbers, props)
        self.targets.index_copy_(0, env_ids, pos)
