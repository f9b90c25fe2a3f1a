"""FrankaCubeStack: an arm picks up cube A and puts it on cube B, as in IsaacGymEnvs.

Published task files keep the published rewards. This project's task file has others:

- A stacked cube pays 4000 and not 16, since it ends the episode, and holding cube A above cube B
  otherwise earns more.
- `shapingRewardScale` pays for grasping, carrying and releasing. The published rewards lead a
  closed gripper to the side of cube A, pay nothing before the cube is 6.5 cm higher, then pay the
  same wherever it is more than 30 cm away from its place, and nothing for letting it go.

The task keeps these quirks, because policies depend on them:

- Operational-space control uses the Jacobian of the hand, but the velocity of the point between the
  fingertips.
- The alignment of a lifted cube counts in two terms, `distance` and `align`.
- A cube is lifted if it is 6.5 cm higher than at its start: the whole edge is subtracted from the
  height of its centre.
- A cube is stacked if the point between the fingertips is more than 4 cm from its centre.

Differences from IsaacGymEnvs: cube B starts on the table and not 1 cm inside it. All entries of an
episode's first observation are current; there some are from the previous episode. Links of the arm
do not collide with each other.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.franka import (
    ARM_EFFORTS_NM,
    LINK7,
    NUM_ARM_JOINTS,
    NUM_JOINTS,
    FrankaConfig,
    FrankaTask,
)
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.scenes import (
    ORANGE,
    add_furniture,
    add_motor,
    add_object,
    add_placing_joints,
    find_body,
    topmost,
)
from isaacgymenvs_lite.utils.rotations import length, normalize_angle

_DEFAULT_POS = (0.0, 0.1963, 0.0, -2.6180, 0.0, 2.9416, 0.7854, 0.035, 0.035)
_STIFFNESS, _DAMPING = 150.0, 2.0 * math.sqrt(150.0)  # of the hand's motion, 1/s^2 and 1/s
_NULL_STIFFNESS, _NULL_DAMPING = 10.0, 2.0 * math.sqrt(10.0)  # of the joints' posture
_MAX_MOTION = (0.1, 0.1, 0.1, 0.5, 0.5, 0.5)  # m and rad, the motion of a full action
_OPEN_M = 0.04  # position of an open finger

_TABLE_SIZE_M, _TABLE_POS_M = (1.2, 1.2, 0.05), (0.0, 0.0, 1.0)
_STAND_SIZE_M, _STAND_POS_M = (0.2, 0.2, 0.1), (-0.5, 0.0, 1.075)
_TABLE_TOP_M = 1.025
SIZE_A_M, SIZE_B_M = 0.05, 0.07
_CUBE_DENSITY = 1000.0
_GREY, _DARK = (0.75, 0.75, 0.78, 1.0), (0.45, 0.47, 0.50, 1.0)
_BLUE = (0.24, 0.36, 0.55, 1.0)
# The cubes start at least the sum of their diagonals apart.
_MIN_DISTANCE_M = (SIZE_A_M + SIZE_B_M) * math.sqrt(2.0)
# Cube B is drawn again after so many draws of cube A, because it leaves no room in the middle of a
# small area.
_DRAWS_PER_CUBE_B = 100

_LIFTED_M = 0.04
_RISE_OF_LIFTED_M = _LIFTED_M + 0.5 * SIZE_A_M
_GRASP_REWARD, _CARRY_REWARD, _RELEASE_REWARD = 0.5, 2.0, 1.5
_STACKED_M = 0.02
_RELEASED_M = 0.04
_RELEASED_GAP_M = 0.03  # between cube A and open fingertips that are above it


@dataclass(frozen=True, kw_only=True)
class FrankaCubeStackConfig(FrankaConfig):
    """`task.env` of FrankaCubeStack."""

    episode_length: int = setting(300, key="episodeLength", minimum=2)
    start_position_noise: float = setting(0.25, key="startPositionNoise", minimum=0.1)  # m
    start_rotation_noise: float = setting(0.785, key="startRotationNoise", minimum=0)  # rad
    franka_position_noise: float = setting(0.0, key="frankaPositionNoise", minimum=0)  # m
    franka_rotation_noise: float = setting(0.0, key="frankaRotationNoise", minimum=0)  # rad
    franka_dof_noise: float = setting(0.25, key="frankaDofNoise", minimum=0)  # rad
    aggregate_mode: int = setting(3, key="aggregateMode")  # no effect
    action_scale: float = setting(1.0, key="actionScale", above=0)
    control_type: str = setting("osc", key="controlType", choices=("osc", "joint_tor"))
    dist_reward_scale: float = setting(0.1, key="distRewardScale")
    lift_reward_scale: float = setting(1.5, key="liftRewardScale")
    align_reward_scale: float = setting(2.0, key="alignRewardScale")
    stack_reward_scale: float = setting(16.0, key="stackRewardScale")
    shaping_reward_scale: float = setting(0.0, key="shapingRewardScale")


def compute_osc_torques(
    motion: Tensor,
    jacobian: Tensor,
    mass_matrix: Tensor,
    velocity: Tensor,
    dof_pos: Tensor,
    dof_vel: Tensor,
    default_dof_pos: Tensor,
) -> Tensor:
    """Return the torques (N, 7) in Nm of operational-space control (Khatib 1987, IsaacGymEnvs).

    The torques move the hand, and in its null space they pull the joints to the default posture.
    They are not limited.

    Args:
        motion: (N, 6) wanted motion of the hand along and about the world axes, m and rad.
        jacobian: (N, 6, 7) of the hand, in world axes.
        mass_matrix: (N, 7, 7) of the arm.
        velocity: (N, 6) linear (m/s) and angular velocity (rad/s), in world axes.
        dof_pos: (N, 7) rad.
        dof_vel: (N, 7) rad/s.
        default_dof_pos: (7,) rad.
    """
    transposed = jacobian.transpose(1, 2)
    posture = _NULL_STIFFNESS * normalize_angle(default_dof_pos - dof_pos) - _NULL_DAMPING * dof_vel
    null_torques = mass_matrix @ posture[:, :, None]
    wanted = (_STIFFNESS * motion - _DAMPING * velocity)[:, :, None]
    # J M^-1 J^T (N, 6, 6) maps forces on the hand to accelerations. The acceleration by the torques
    # for the posture is subtracted, so that the hand is accelerated as wanted.
    moved = torch.linalg.solve(mass_matrix, transposed)
    forces = torch.linalg.solve(jacobian @ moved, wanted - moved.transpose(1, 2) @ null_torques)
    return (null_torques + transposed @ forces).squeeze(-1)


def compute_franka_reward(
    cube_a_pos: Tensor,
    cube_b_pos: Tensor,
    grip_pos: Tensor,
    left_tip_pos: Tensor,
    right_tip_pos: Tensor,
    cfg: FrankaCubeStackConfig,
) -> Terms:
    """Return the reward terms (N,) for positions (N, 3) in m in the world frame.

    `grip_pos` is the point between the fingertips. Where cube A is stacked, all terms except
    `stack` are zero.
    """
    is_stacked = compute_stacked(cube_a_pos, cube_b_pos, grip_pos)
    to_hand = torch.stack((grip_pos, left_tip_pos, right_tip_pos)) - cube_a_pos
    distances = length(to_hand)
    near = 1.0 - torch.tanh(10.0 / 3.0 * distances.sum(0))
    is_lifted = (cube_a_pos[:, 2] - _TABLE_TOP_M - SIZE_A_M) > _LIFTED_M
    to_place = cube_b_pos - cube_a_pos
    to_place[:, 2] += 0.5 * (SIZE_A_M + SIZE_B_M)
    to_place_m = length(to_place)
    aligned = (1.0 - torch.tanh(10.0 * to_place_m)) * is_lifted
    # `between` is 1 if cube A is in the middle of the fingertips, and 0 if both are on one side.
    cosine = (to_hand[1] * to_hand[2]).sum(-1) / distances[1:].prod(0).clamp(min=1e-6)
    between = 0.5 * (1.0 - cosine)
    gap = (distances[1:].mean(0) - 0.5 * SIZE_A_M).clamp(min=0.0)
    rise = (cube_a_pos[:, 2] - _TABLE_TOP_M - 0.5 * SIZE_A_M) / _RISE_OF_LIFTED_M
    carried = rise.clamp(0.0, 1.0) * (1.0 - to_place_m).clamp(min=0.0)
    released = aligned * (gap / _RELEASED_GAP_M).clamp(max=1.0)
    shaping = cfg.shaping_reward_scale
    open_terms = {
        "distance": cfg.dist_reward_scale * torch.maximum(near, aligned),
        "lift": cfg.lift_reward_scale * is_lifted,
        "align": cfg.align_reward_scale * aligned,
        "grasp": shaping * _GRASP_REWARD * between * (1.0 - torch.tanh(20.0 * gap)),
        "carry": shaping * _CARRY_REWARD * carried,
        "release": shaping * _RELEASE_REWARD * released,
    }
    terms = {name: term.masked_fill(is_stacked, 0.0) for name, term in open_terms.items()}
    return {**terms, "stack": cfg.stack_reward_scale * is_stacked}


def compute_stacked(cube_a_pos: Tensor, cube_b_pos: Tensor, grip_pos: Tensor) -> Tensor:
    """Return where (N,) cube A lies on cube B and is released; positions (N, 3) m."""
    aside = length((cube_b_pos - cube_a_pos)[:, :2])
    height = cube_a_pos[:, 2] - _TABLE_TOP_M
    return (
        (aside < _STACKED_M)
        & ((height - (SIZE_B_M + 0.5 * SIZE_A_M)).abs() < _STACKED_M)
        & (length(cube_a_pos - grip_pos) > _RELEASED_M)
    )


def draw_cubes(env_ids: Tensor, max_distance_m: float, max_yaw_rad: float) -> Tensor:
    """Draw states (n, 2, 13) of cubes A and B at rest on the table, not too near to each other.

    `max_distance_m`, the largest distance from the middle along x and y, is at least 0.1 m.
    """
    states = torch.zeros(len(env_ids), 2, 13, device=env_ids.device)
    states[:, 0, 2] = _TABLE_TOP_M + 0.5 * SIZE_A_M
    states[:, 1, 2] = _TABLE_TOP_M + 0.5 * SIZE_B_M
    half_yaw = 0.5 * uniform(env_ids, -max_yaw_rad, max_yaw_rad, (2,))
    states[..., 5], states[..., 6] = half_yaw.sin(), half_yaw.cos()
    missing = torch.arange(len(env_ids), device=env_ids.device)
    for draws in itertools.count():
        if draws % _DRAWS_PER_CUBE_B == 0:
            states[missing, 1, :2] = uniform(missing, -max_distance_m, max_distance_m, (2,))
        states[missing, 0, :2] = uniform(missing, -max_distance_m, max_distance_m, (2,))
        apart = length(states[missing, 0, :2] - states[missing, 1, :2])
        missing = missing[apart < _MIN_DISTANCE_M]
        if len(missing) == 0:
            break
    return states


class FrankaCubeStack(FrankaTask):
    """N arms with two cubes on a table.

    With `controlType: osc` there are 19 observations and 7 actions: a motion of the hand in 6
    dimensions, and the gripper. With `joint_tor` there are 26 observations and 8 actions: torques
    of the joints, and the gripper. A gripper action of at least 0 opens the gripper.
    """

    settings_class = FrankaCubeStackConfig
    base_pos = (-0.45, 0.0, 1.125)
    base_quat_wxyz = (1.0, 0.0, 0.0, 0.0)

    def set_sizes(self) -> None:
        """Set the sizes of observation and actions for `controlType`."""
        self._has_osc = self.env_cfg.control_type == "osc"
        self.num_observations, self.num_actions = (19, 7) if self._has_osc else (26, 8)

    def add_arm_drives(self, spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint]) -> None:
        """Add motors."""
        for joint, effort in zip(joints, ARM_EFFORTS_NM, strict=True):
            add_motor(spec, joint, effort)

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add the table, the stand of the arm and the cubes."""
        cfg = self.env_cfg
        if cfg.franka_position_noise > 0 or cfg.franka_rotation_noise > 0:
            base = topmost(find_body(spec, LINK7))
            self.placing_joints = add_placing_joints(base, "xyr")
        add_furniture(spec, "table", _TABLE_SIZE_M, _TABLE_POS_M, _GREY)
        add_furniture(spec, "table_stand", _STAND_SIZE_M, _STAND_POS_M, _DARK)
        for name, size, x, colour in (
            ("cubeA", SIZE_A_M, -0.1, ORANGE),
            ("cubeB", SIZE_B_M, 0.1, _BLUE),
        ):
            pos = (x, 0.0, _TABLE_TOP_M + 0.5 * size)
            add_object(spec, name, (0.5 * size,) * 3, pos, _CUBE_DENSITY, rgba=colour)

    def create_sim(self) -> None:
        """Create the simulations; draw the places of the bases."""
        super().create_sim()
        device, cfg = self.device, self.env_cfg
        self._arm_joints = self.joint_names[:NUM_ARM_JOINTS]
        self._default_pos = torch.tensor(_DEFAULT_POS, device=device)
        self._efforts = torch.tensor(ARM_EFFORTS_NM, device=device)
        self._max_motion = torch.tensor(_MAX_MOTION, device=device) / cfg.action_scale
        noise = (cfg.franka_position_noise, cfg.franka_position_noise, cfg.franka_rotation_noise)
        everywhere = torch.arange(self.num_envs, device=device)
        spread = torch.tensor(noise, device=device)[: len(self.placing_joints)]
        self._places = spread * uniform(everywhere, -1.0, 1.0, (len(spread),))

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return torques (N, 7) in Nm and the positions (N, 2) of the fingers in m."""
        arm, gripper = actions[:, :-1], actions[:, -1:]
        torques = self._osc_torques(arm) if self._has_osc else self._joint_torques(arm)
        return torch.cat((torques, (gripper >= 0.0) * _OPEN_M, (gripper >= 0.0) * _OPEN_M), dim=-1)

    def _joint_torques(self, actions: Tensor) -> Tensor:
        return actions * (self._efforts / self.env_cfg.action_scale)

    def _osc_torques(self, actions: Tensor) -> Tensor:
        """Return the torques (N, 7) that move the hand."""
        sim, grip = self.simulation, self._bodies["grip"]
        torques = compute_osc_torques(
            actions * self._max_motion,
            sim.jacobian(self.body_names_of_franka["hand"], self._arm_joints),
            sim.mass_matrix(self._arm_joints),
            torch.cat((sim.body_lin_vel[:, grip], sim.body_ang_vel[:, grip]), dim=-1),
            self.joint_pos()[:, :NUM_ARM_JOINTS],
            self.joint_vel()[:, :NUM_ARM_JOINTS],
            self._default_pos[:NUM_ARM_JOINTS],
        )
        return torques.clamp(-self._efforts, self._efforts)

    def _cubes(self) -> tuple[Tensor, Tensor]:
        """Return the states (N, 13) of cubes A and B."""
        cube_a, cube_b = self.simulation.object_states.unbind(1)
        return cube_a, cube_b

    def observation_groups(self) -> dict[str, int]:
        """Return the parts of the observation; positions are in m and rotations are xyzw."""
        cubes = {"cube_a_rot_xyzw": 4, "cube_a_pos": 3, "cube_a_to_cube_b": 3}
        fingers = {"finger_pos": 2} if self._has_osc else {"dof_pos": NUM_JOINTS}
        return cubes | {"grip_pos": 3, "grip_rot_xyzw": 4} | fingers

    def compute_obs(self) -> Tensor:
        """See `observation_groups`."""
        cube_a, cube_b = self._cubes()
        joints = self.joint_pos()
        return torch.cat(
            (
                cube_a[:, 3:7],
                cube_a[:, :3],
                cube_b[:, :3] - cube_a[:, :3],
                self.pos_w("grip"),
                self.rot_w("grip"),
                joints[:, NUM_ARM_JOINTS:] if self._has_osc else joints,
            ),
            dim=-1,
        )

    def compute_reward_terms(self) -> Terms:
        """See `compute_franka_reward`."""
        cube_a, cube_b = self._cubes()
        return compute_franka_reward(
            cube_a[:, :3],
            cube_b[:, :3],
            self.pos_w("grip"),
            self.pos_w("left_tip"),
            self.pos_w("right_tip"),
            self.env_cfg,
        )

    def compute_reached(self) -> Tensor:
        """See `compute_stacked`."""
        cube_a, cube_b = self._cubes()
        return compute_stacked(cube_a[:, :3], cube_b[:, :3], self.pos_w("grip"))

    def episode_successes(self) -> dict[str, Tensor]:
        """Return whether cube A is stacked."""
        return {"stacked": self.compute_reached()}

    def reset_state(self, env_ids: Tensor) -> None:
        """Draw joint positions near the default pose, and places of the cubes."""
        cfg, n = self.env_cfg, len(env_ids)
        cubes = draw_cubes(env_ids, cfg.start_position_noise, cfg.start_rotation_noise)
        pos = self._default_pos.repeat(n, 1)
        noise = cfg.franka_dof_noise
        pos[:, :NUM_ARM_JOINTS] += uniform(env_ids, -noise, noise, (NUM_ARM_JOINTS,))
        pos = pos.clamp(self.lower_limits, self.upper_limits)
        self.write_joints(env_ids, pos, self._places.index_select(0, env_ids))
        both = torch.arange(2, device=self.device)
        self.simulation.write_object_states(env_ids, both, cubes)
