"""Trifinger: three fingers move a cube on a table to a goal pose, as in IsaacGymEnvs.

The task keeps two quirks: the weight of the eight corners is `object_dist.weight`, and reaching the
goal does not end an episode.

Differences from IsaacGymEnvs: an episode starts without an additional simulator call. The reward of
its first step uses where the fingertips started (there: where the last episode ended). An episode
succeeds if the cube is at its goal in the last step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.rendering.markers import GO_COLOUR, Marker, Solid
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.rows import body_rows, dof_rows
from isaacgymenvs_lite.tasks.base.scenes import (
    Names,
    add_motor,
    add_object,
    find_body,
    find_joint,
    limit_speed,
    remove_controls,
)
from isaacgymenvs_lite.tasks.base.task_config import TaskConfig
from isaacgymenvs_lite.tasks.base.wrenches import add_wrench_sensors, measure_wrenches
from isaacgymenvs_lite.utils.rotations import (
    length,
    normalize,
    quat_diff_rad,
    quat_from_angle_axis,
    rotate_components,
)
from isaacgymenvs_lite.utils.scaling import scale, unscale

_FINGERS = ("0", "120", "240")
_JOINTS: tuple[Names, ...] = tuple(
    (f"finger_{joint}_joint_{finger}",)
    for finger in _FINGERS
    for joint in ("base_to_upper", "upper_to_middle", "middle_to_lower")
)
_TIPS: tuple[Names, ...] = tuple(
    (f"finger_tip_link_{finger}", f"tip_{finger}") for finger in _FINGERS
)
NUM_JOINTS, NUM_TIPS = len(_JOINTS), len(_TIPS)
_EFFORT_NM = 0.36
_MAX_SPEED_RAD_S = 10.0
_STIFFNESS = 10.0  # Nm/rad, of `command_mode: position`
_DAMPING = (0.1, 0.3, 0.001) * 3  # Nm s/rad
_SAFETY_DAMPING = (0.08, 0.08, 0.04) * 3  # Nm s/rad
_DEFAULT_POS_RAD = (0.0, 0.9, -2.0) * 3
# Friction between the table and other geoms: the mean of the published 0.1 and 1, as in PhysX.
_TABLE_FRICTION = 0.55
_FLOOR_HEIGHT_M = -0.013

SIZE_M = 0.065
_DENSITY = 291.3
_HALF_M = 0.5 * SIZE_M
_CUBE_RADIUS_M = _HALF_M * math.sqrt(3.0)
_MAX_DISTANCE_M = 0.195 - _CUBE_RADIUS_M  # of the cube's centre from the middle
_MAX_HEIGHT_M = 0.1
_START_HEIGHT_M = _HALF_M + 0.0015
_LIFTED_GOAL_M = _HALF_M + 0.05

_REACH_STEPS = 5e7  # environment steps during which reaching for the cube is rewarded
_POSE_LOW = (-0.3, -0.3, 0.0, -1.0, -1.0, -1.0, -1.0)
_POSE_HIGH = (0.3, 0.3, 0.3, 1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True)
class ObjectStart:
    """`task.env.reset_distribution.object_initial_state`."""

    type: str = setting("random", choices=("random", "default", "none"))


@dataclass(frozen=True)
class RobotStart:
    """`task.env.reset_distribution.robot_initial_state`."""

    type: str = setting("default", choices=("random", "default", "none"))
    dof_pos_stddev: float = setting(0.4, minimum=0)  # rad
    dof_vel_stddev: float = setting(0.2, minimum=0)  # rad/s


@dataclass(frozen=True)
class ResetDistribution:
    """`task.env.reset_distribution`."""

    object_initial_state: ObjectStart = field(default_factory=ObjectStart)
    robot_initial_state: RobotStart = field(default_factory=RobotStart)


@dataclass(frozen=True)
class RewardTerm:
    """A section of `task.env.reward_terms`."""

    weight: float = setting()
    activate: bool = setting(True)
    norm_p: float = setting(2.0)  # no effect


@dataclass(frozen=True)
class RewardTerms:
    """`task.env.reward_terms`."""

    finger_move_penalty: RewardTerm = RewardTerm(weight=-0.5)
    finger_reach_object_rate: RewardTerm = RewardTerm(weight=-250.0)
    object_dist: RewardTerm = RewardTerm(weight=2000.0)
    object_rot: RewardTerm = RewardTerm(weight=2000.0)
    keypoints_dist: RewardTerm = RewardTerm(weight=2000.0)


@dataclass(frozen=True)
class SuccessTolerances:
    """`task.env.termination_conditions.success`."""

    orientation_tolerance: float = setting(0.4, minimum=0)  # rad
    position_tolerance: float = setting(0.02, minimum=0)  # m


@dataclass(frozen=True)
class TerminationConditions:
    """`task.env.termination_conditions`."""

    success: SuccessTolerances = field(default_factory=SuccessTolerances)


@dataclass(frozen=True, kw_only=True)
class TrifingerConfig(TaskConfig):
    """`task.env` of Trifinger."""

    episode_length: int = setting(750, key="episodeLength", minimum=2)
    aggregate_mode: bool = setting(True)  # no effect
    control_decimation: int = setting(1)  # no effect
    task_difficulty: int = setting(4, choices=(-1, 1, 2, 3, 4))
    enable_ft_sensors: bool = setting(False)  # no effect: the critic's sensors are always there
    asymmetric_obs: bool = setting(True)
    normalize_obs: bool = setting(True)
    apply_safety_damping: bool = setting(True)
    command_mode: str = setting("torque", choices=("torque", "position"))
    normalize_action: bool = setting(True)
    cube_obs_keypoints: bool = setting(True)  # no effect
    reset_distribution: ResetDistribution = field(default_factory=ResetDistribution)
    reward_terms: RewardTerms = field(default_factory=RewardTerms)
    termination_conditions: TerminationConditions = field(default_factory=TerminationConditions)


def lgsk_kernel(x: Tensor, scale: float = 50.0, eps: float = 2.0) -> Tensor:
    """Return 1 / (exp(scale x) + eps + exp(-scale x)), the logistic kernel of IsaacGymEnvs."""
    scaled = scale * x
    return 1.0 / (scaled.exp() + eps + (-scaled).exp())


def gen_keypoints(
    pose: Tensor,
    num_keypoints: int = 8,
    size: tuple[float, float, float] = (SIZE_M, SIZE_M, SIZE_M),
) -> Tensor:
    """Return the corners (N, 8, 3) in m of boxes at poses (N, 7): position (m), rotation xyzw.

    Bit k of the number of a corner is 1 if the corner has a negative coordinate k.
    """
    signs = [[1.0 - 2.0 * (i >> axis & 1) for axis in range(3)] for i in range(num_keypoints)]
    corners = 0.5 * pose.new_tensor(signs) * pose.new_tensor(size)
    rows = pose.t()
    # The axes of the boxes in world axes, (3 axes, 3 components, N).
    axes = torch.stack([_axis_rows(rows[3:7], axis) for axis in range(3)])
    offsets = (corners @ axes.flatten(1)).unflatten(1, (3, -1))
    return (rows[:3] + offsets).permute(2, 0, 1)


def _axis_rows(rotation: Tensor, axis: int) -> Tensor:
    """Return an axis (3, N) of frames with rotations (4, N) xyzw, in world axes."""
    unit = torch.eye(3, device=rotation.device)[axis, :, None].expand(3, rotation.shape[1])
    return torch.stack(rotate_components(rotation, unit))


def random_xy(
    num: int, max_com_distance_to_center: float, device: str | torch.device
) -> tuple[Tensor, Tensor]:
    """Return x and y (num,) in m, uniform in a circle about the origin."""
    radius = max_com_distance_to_center * torch.rand(num, device=device).sqrt()
    angle = 2.0 * math.pi * torch.rand(num, device=device)
    return radius * angle.cos(), radius * angle.sin()


def random_z(num: int, min_height: float, max_height: float, device: str | torch.device) -> Tensor:
    """Return heights (num,) in m, uniform between the limits."""
    return min_height + (max_height - min_height) * torch.rand(num, device=device)


def default_orientation(num: int, device: str | torch.device) -> Tensor:
    """Return identity rotations (num, 4) xyzw."""
    return torch.tensor((0.0, 0.0, 0.0, 1.0), device=device).repeat(num, 1)


def random_orientation(num: int, device: str | torch.device) -> Tensor:
    """Return uniform random rotations (num, 4) xyzw."""
    return normalize(torch.randn(num, 4, device=device))


def random_yaw_orientation(num: int, device: str | torch.device) -> Tensor:
    """Return rotations (num, 4) xyzw about z by uniform random angles."""
    angle = 2.0 * math.pi * torch.rand(num, device=device)
    z = torch.tensor((0.0, 0.0, 1.0), device=device).repeat(num, 1)
    return quat_from_angle_axis(angle, z)


def draw_goals(num: int, difficulty: int, device: str | torch.device) -> Tensor:
    """Return goal poses (num, 7) of a `task_difficulty`: position (m), rotation xyzw."""
    x, y = random_xy(num, _MAX_DISTANCE_M, device)
    z = torch.full((num,), _HALF_M, device=device)
    rotation = default_orientation(num, device)
    if difficulty == -1:
        rotation = random_yaw_orientation(num, device)
    elif difficulty == 2:
        x, y, z = torch.zeros_like(x), torch.zeros_like(y), torch.full_like(z, _LIFTED_GOAL_M)
    elif difficulty == 3:
        z = random_z(num, _HALF_M, _MAX_HEIGHT_M, device)
    elif difficulty == 4:
        z = random_z(num, _CUBE_RADIUS_M, _MAX_HEIGHT_M, device)
        rotation = random_orientation(num, device)
    return torch.cat((torch.stack((x, y, z), dim=-1), rotation), dim=-1)


def compute_trifinger_reward(
    object_pose: Tensor,
    last_object_pos: Tensor,
    goal_pose: Tensor,
    tip_pos: Tensor,
    last_tip_pos: Tensor,
    dt_s: float,
    reaches: bool,
    terms: RewardTerms,
) -> Terms:
    """Return the reward terms (N,).

    Args:
        object_pose: (N, 7) position (m), rotation xyzw.
        last_object_pos: (N, 3) m, one control step ago.
        goal_pose: (N, 7).
        tip_pos: (N, 3 tips, 3) m.
        last_tip_pos: (N, 3 tips, 3) m, one control step ago.
        dt_s: time of a simulator call.
        reaches: whether approaching the cube is still rewarded.
        terms: the weights.
    """
    object_pos = object_pose[:, :3]
    speed = length(tip_pos - last_tip_pos) / dt_s
    distance = length(tip_pos - object_pos[:, None])
    last_distance = length(last_tip_pos - last_object_pos[:, None])
    reach_weight = terms.finger_reach_object_rate.weight if reaches else 0.0
    result = {
        "finger_movement": terms.finger_move_penalty.weight * speed.square().sum(-1),
        "finger_reach": reach_weight * (distance - last_distance).sum(-1),
    }
    weight = dt_s * terms.object_dist.weight
    if terms.keypoints_dist.activate:
        apart = length(gen_keypoints(object_pose) - gen_keypoints(goal_pose))
        return {**result, "pose": weight * lgsk_kernel(apart, scale=30.0).mean(-1)}
    apart = length(object_pos - goal_pose[:, :3])
    angle = quat_diff_rad(object_pose[:, 3:7], goal_pose[:, 3:7]).abs()
    return {
        **result,
        "position": weight * lgsk_kernel(apart, scale=50.0),
        "rotation": dt_s * terms.object_rot.weight / (3.0 * angle + 0.01),
    }


class Trifinger(MjcfTask):
    """N robots of three fingers, with 9 actions, 41 observations and 113 values for the critic."""

    settings_class = TrifingerConfig
    default_asset = "mjcf/trifinger.xml"
    published_assets = ("trifinger/robot_properties/urdf/pro/trifingerpro.urdf",)
    actor_name = "robot"
    other_actors: ClassVar[dict[str, str]] = {"object": "object", "table": "table"}
    num_observations = 41
    num_actions = NUM_JOINTS
    starts_before_physics = True

    def read_settings(self, env: dict[str, Any]) -> TaskConfig:
        """Return the checked keys of `task.env`; `asymmetric_obs` is this task's published key."""
        env.setdefault("asymmetric_observations", env.get("asymmetric_obs", True))
        return super().read_settings(env)

    def states_size(self) -> int:
        """Return the size of the privileged observation."""
        return self.num_observations + 6 + 13 * NUM_TIPS + NUM_JOINTS + 6 * NUM_TIPS

    # --- the model --------------------------------------------------------------------------

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Add motors, sensors and the cube."""
        joints = [find_joint(spec, names) for names in _JOINTS]
        tips = [find_body(spec, names) for names in _TIPS]
        find_body(spec, ("table",))  # raises ConfigError if the file has none
        remove_controls(spec)
        if (floor := spec.geom("floor")) is not None:
            floor.pos[2] = _FLOOR_HEIGHT_M
        for joint in joints:
            limit_speed(joint, _EFFORT_NM, _MAX_SPEED_RAD_S)
            add_motor(spec, joint, _EFFORT_NM)
        self._joint_names = [joint.name for joint in joints]
        self._tip_names = [tip.name for tip in tips]
        add_wrench_sensors(spec, self._tip_names)
        start = (0.0, 0.0, _START_HEIGHT_M)
        add_object(spec, "object", (_HALF_M, _HALF_M, _HALF_M), start, _DENSITY)

    def build_model(self) -> mujoco.MjModel:
        """Return the compiled model with the friction of the table."""
        model = super().build_model()
        model.geom_friction[model.geom_bodyid == model.body("table").id, 0] = _TABLE_FRICTION
        return model

    def create_sim(self) -> None:
        """Create the simulations and look up joints and fingertips."""
        super().create_sim()
        sim, device = self.simulation, self.device
        self._dofs, self._lower, self._upper = self.find_joints(self._joint_names)
        tips = [sim.body_names.index(name) for name in self._tip_names]
        self._tips = torch.tensor(tips, device=device)
        self._default_pos = torch.tensor(_DEFAULT_POS_RAD, device=device)
        self._damping = torch.tensor(_DAMPING, device=device)
        self._safety_damping = torch.tensor(_SAFETY_DAMPING, device=device)
        self._action_low, self._action_high = self._action_limits()
        pose_low, pose_high = (torch.tensor(p, device=device) for p in (_POSE_LOW, _POSE_HIGH))
        speeds = torch.full((NUM_JOINTS,), _MAX_SPEED_RAD_S, device=device)
        ones = torch.ones(NUM_JOINTS, device=device)
        normal = self.env_cfg.normalize_action
        low, high = (-ones, ones) if normal else (self._action_low, self._action_high)
        self._obs_low = torch.cat((self._lower, -speeds, pose_low, pose_low, low))
        self._obs_high = torch.cat((self._upper, speeds, pose_high, pose_high, high))

    def _action_limits(self) -> tuple[Tensor, Tensor]:
        """Return the limits (9,) of torques (Nm) or positions (rad)."""
        if self.env_cfg.command_mode == "position":
            return self._lower, self._upper
        effort = torch.full((NUM_JOINTS,), _EFFORT_NM, device=self.device)
        return -effort, effort

    def allocate_buffers(self) -> None:
        """Add goals and the previous positions."""
        super().allocate_buffers()
        n, device = self.num_envs, self.device
        self.goal_poses = torch.zeros(n, 7, device=device)
        self.goal_poses[:, 6] = 1.0
        self._last_tip_pos = torch.zeros(n, NUM_TIPS, 3, device=device)
        self._last_object_pos = torch.zeros(n, 3, device=device)

    # --- a step -----------------------------------------------------------------------------

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the torques (N, 9) in Nm."""
        sim, cfg = self.simulation, self.env_cfg
        self._last_tip_pos.copy_(sim.body_pos.index_select(1, self._tips))
        self._last_object_pos.copy_(self._object()[:, :3])
        wanted = scale(actions, self._action_low, self._action_high)
        wanted = wanted if cfg.normalize_action else actions
        pos, vel = self._of_joints(sim.dof_pos), self._of_joints(sim.dof_vel)
        if cfg.command_mode == "position":
            wanted = _STIFFNESS * (wanted - pos) - self._damping * vel
        torques = wanted.clamp(-_EFFORT_NM, _EFFORT_NM)
        if cfg.apply_safety_damping:
            torques = (torques - self._safety_damping * vel).clamp(-_EFFORT_NM, _EFFORT_NM)
        return torques

    def compute_reward_terms(self) -> Terms:
        """See `compute_trifinger_reward`."""
        env_steps = self.control_steps * self.control_freq_inv * self.num_envs
        return compute_trifinger_reward(
            self._object()[:, :7],
            self._last_object_pos,
            self.goal_poses,
            self.simulation.body_pos.index_select(1, self._tips),
            self._last_tip_pos,
            self.sim_dt_s,
            env_steps <= _REACH_STEPS,
            self.env_cfg.reward_terms,
        )

    def episode_successes(self) -> dict[str, Tensor]:
        """Return whether the cube is at its goal, within the published tolerances."""
        cube, tolerance = self._object(), self.env_cfg.termination_conditions.success
        apart = length(cube[:, :3] - self.goal_poses[:, :3])
        is_there = apart <= tolerance.position_tolerance
        if self.env_cfg.task_difficulty == 4:
            angle = quat_diff_rad(cube[:, 3:7], self.goal_poses[:, 3:7]).abs()
            is_there &= angle <= tolerance.orientation_tolerance
        return {"at_goal": is_there}

    # --- observations -----------------------------------------------------------------------

    def _object(self) -> Tensor:
        """Return the states (N, 13) of the cubes."""
        return self.simulation.object_states[:, 0]

    def _of_joints(self, values: Tensor) -> Tensor:
        """Return the values (N, 9) of the joints in the published order."""
        return values.index_select(1, self._dofs)

    def observation_groups(self) -> dict[str, int]:
        """Return the parts of the observation."""
        joints = {"dof_pos": NUM_JOINTS, "dof_vel": NUM_JOINTS}
        return joints | {"object_pose": 7, "goal_pose": 7, "last_actions": NUM_JOINTS}

    def _raw_rows(self) -> Tensor:
        """Return the observations as rows (41, N) in rad, rad/s and m."""
        sim = self.simulation
        joints = (dof_rows(self._dofs, sim.dof_pos), dof_rows(self._dofs, sim.dof_vel))
        return torch.cat(
            (*joints, self._object()[:, :7].t(), self.goal_poses.t(), self.actions.t())
        )

    def compute_obs(self) -> Tensor:
        """Return the observations (N, 41); `normalize_obs` scales limits to [-1, 1]."""
        raw = self._raw_rows().t()
        return unscale(raw, self._obs_low, self._obs_high) if self.env_cfg.normalize_obs else raw

    def compute_states(self, env_ids: Tensor | None, observations: Tensor) -> Tensor:
        """Return the privileged observations (n, 113).

        The observation in rad, rad/s and m is followed by the velocities of the cube, the states
        (13,) of the fingertips, the torques of the joints, and the contact wrenches on the
        fingertips.
        """
        sim = self.simulation
        tips = (sim.body_pos, sim.body_rot, sim.body_lin_vel, sim.body_ang_vel)
        rows = (
            self._raw_rows(),
            self._object()[:, 7:].t(),
            body_rows(self._tips, *tips),
            dof_rows(self._dofs, sim.dof_forces),
            measure_wrenches(sim, self._tip_names),
        )
        states = torch.cat(rows).t()
        return states if env_ids is None else states.index_select(0, env_ids)

    # --- starts -----------------------------------------------------------------------------

    def reset_state(self, env_ids: Tensor) -> None:
        """Draw the states of robots and cubes, and the goals."""
        sim, n, device = self.simulation, len(env_ids), self.device
        start = self.env_cfg.reset_distribution
        cubes = self._object().index_select(0, env_ids)
        dof_pos, dof_vel = (
            values.index_select(0, env_ids) for values in (sim.dof_pos, sim.dof_vel)
        )
        robot = start.robot_initial_state
        if robot.type != "none":
            spread = (robot.dof_pos_stddev, robot.dof_vel_stddev)
            pos_noise, vel_noise = spread if robot.type == "random" else (0.0, 0.0)
            noise = uniform(env_ids, -pos_noise, pos_noise, (NUM_JOINTS,))
            dof_pos[:, self._dofs] = self._default_pos + noise
            dof_vel[:, self._dofs] = uniform(env_ids, -vel_noise, vel_noise, (NUM_JOINTS,))
        sim.write_state(env_ids, torch.zeros(n, 13, device=device), dof_pos, dof_vel)
        if start.object_initial_state.type != "none":
            cubes = torch.zeros(n, 13, device=device)
            cubes[:, 2], cubes[:, 6] = _HALF_M, 1.0
            if start.object_initial_state.type == "random":
                cubes[:, 0], cubes[:, 1] = random_xy(n, _MAX_DISTANCE_M, device)
                cubes[:, 2] = _START_HEIGHT_M
                cubes[:, 3:7] = random_yaw_orientation(n, device)
        sim.write_object_states(env_ids, torch.zeros(1, dtype=torch.int64), cubes[:, None])
        goals = draw_goals(n, self.env_cfg.task_difficulty, device)
        self.goal_poses.index_copy_(0, env_ids, goals)

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return the goal."""
        x, y, z, i, j, k, w = self.goal_poses[env_id].tolist()
        box = int(mujoco.mjtGeom.mjGEOM_BOX)
        return (Solid(box, (_HALF_M, _HALF_M, _HALF_M), (x, y, z), (w, i, j, k), GO_COLOUR),)
