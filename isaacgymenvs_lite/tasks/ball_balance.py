"""BallBalance: a tray on three legs balances a ball that falls onto it, as in IsaacGymEnvs.

The task keeps two quirks from IsaacGymEnvs. The observation lists each torque component of all
three sensors before the next component. Of the three force components, the observation contains
only x.

MuJoCo has no counterpart of Isaac Gym's force sensors. The three sensors instead measure the
contact force on the tray and its torque about three points, in the tray's frame. The sensors
exclude the forces of legs and joints. The feet are pinned to the ground and do not collide with it.
The ball has no angular damping.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.assets import hinge_limits
from isaacgymenvs_lite.tasks.base.drives import integrate_drives_implicitly
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.task_config import TaskConfig
from isaacgymenvs_lite.tasks.base.wrenches import measure_wrenches, torques_about

_DRIVEN_JOINTS = ("lower_leg_joint0", "lower_leg_joint1", "lower_leg_joint2")
_BALL_RADIUS_M = 0.1
_PAID_HEIGHT_M = 0.7
_LOST_HEIGHT_M = 1.5 * _BALL_RADIUS_M
_SENSOR_SCALE = 1.0 / 20.0
_SENSOR_DISTANCE_M = 0.4  # from the middle of the tray
_SENSOR_ANGLES_RAD = (0.0, math.radians(120.0), math.radians(240.0))

_START_DISTANCE_M = (0.001, 0.5)  # from the vertical axis of the tray
_START_HEIGHT_M = (1.0, 2.0)
_MAX_START_SPEED_M_S = 5.0  # towards the axis from the largest start distance
_START_FALL_M_S = 5.0


@dataclass(frozen=True, kw_only=True)
class BallBalanceConfig(TaskConfig):
    """`task.env` of BallBalance."""

    episode_length: int = setting(500, key="maxEpisodeLength", minimum=2)
    action_speed_scale: float = setting(20.0, key="actionSpeedScale", minimum=0)  # rad/s


def compute_bbot_observations(
    dof_pos: Tensor,
    dof_vel: Tensor,
    ball_pos: Tensor,
    ball_vel: Tensor,
    sensor_force_x: Tensor,
    sensor_torques: Tensor,
) -> Tensor:
    """Return the observations (N, 24).

    First come positions (rad) and velocities (rad/s) of the driven joints, and position (m) and
    velocity (m/s) of the ball, (N, 3) each. Then come the sensors' forces (3, N) along x and
    torques (3, 3, N) about x, y and z. Forces and torques are in the tray's frame and divided by
    20.
    """
    sensors = torch.cat((sensor_force_x, sensor_torques.flatten(0, 1))).t()
    return torch.cat((dof_pos, dof_vel, ball_pos, ball_vel, sensors * _SENSOR_SCALE), dim=-1)


def compute_bbot_reward(ball_pos: Tensor, ball_vel: Tensor) -> Terms:
    """Return the terms (N,) of the reward 1 / (1 + distance) / (1 + speed).

    `near` is the reward of a ball at rest, and is largest on the tray's axis 0.7 m above the
    ground. `speed` is the negative amount that the ball's speed adds to the reward.
    """
    x, y, z = ball_pos.unbind(-1)
    near = 1.0 / (1.0 + torch.sqrt(x * x + y * y + (z - _PAID_HEIGHT_M).square()))
    speed = ball_vel.norm(dim=-1)
    return {"near": near, "speed": near / (1.0 + speed) - near}


def compute_bbot_failures(ball_height: Tensor) -> Tensor:
    """Return where (N,) the ball, whose height is in m, fell off the tray."""
    return ball_height < _LOST_HEIGHT_M


def draw_ball_states(env_ids: Tensor) -> Tensor:
    """Draw states (n, 13) of balls that fall onto the tray and move towards its middle."""
    nearest, farthest = _START_DISTANCE_M
    distance = uniform(env_ids, nearest, farthest)
    angle = uniform(env_ids, -math.pi, math.pi)
    share = (distance - nearest) / (farthest - nearest)
    speed = -share * uniform(env_ids, 0.0, _MAX_START_SPEED_M_S)
    states = torch.zeros(len(env_ids), 13, device=env_ids.device)
    states[:, 0], states[:, 1] = distance * angle.cos(), distance * angle.sin()
    states[:, 2] = uniform(env_ids, *_START_HEIGHT_M)
    states[:, 6] = 1.0
    states[:, 7], states[:, 8] = speed * angle.cos(), speed * angle.sin()
    states[:, 9] = -_START_FALL_M_S
    return states


class BallBalance(MjcfTask):
    """N trays with balls, 24 observations and 3 actions.

    Each action is the speed at which the position target of a lower leg's joint moves.
    """

    settings_class = BallBalanceConfig
    default_asset = "mjcf/ball_balance.xml"
    actor_name = "bbot"
    num_observations = 24
    num_actions = 3
    starts_before_physics = True
    zero_action_at_reset = True

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Integrate the drives implicitly, because the ground closes the kinematic chain."""
        integrate_drives_implicitly(spec, self.sim_cfg.dt / self.sim_cfg.substeps)

    def create_sim(self) -> None:
        """Create the simulations and look up joints, tray and sensors."""
        super().create_sim()
        device = self.device
        driven = [self.simulation.dof_names.index(name) for name in _DRIVEN_JOINTS]
        limits = torch.from_numpy(hinge_limits(self._model, self._layout)).float().to(device)
        self._driven = torch.tensor(driven, device=device)
        self._lower, self._upper = limits[driven].unbind(-1)
        self.initial_root = torch.zeros(13, device=device)
        self.initial_root[2], self.initial_root[6] = float(self._model.qpos0[2]), 1.0
        self._ball = self.simulation.object_names.index("ball")
        angles = torch.tensor(_SENSOR_ANGLES_RAD, device=device)
        directions = (angles.cos(), angles.sin(), torch.zeros_like(angles))
        self._sensor_points = _SENSOR_DISTANCE_M * torch.stack(directions, dim=-1)

    def allocate_buffers(self) -> None:
        """Add the position targets."""
        super().allocate_buffers()
        self.targets = torch.zeros(self.num_envs, self.num_actions, device=self.device)  # rad

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Move the position targets (N, 3) in rad by the actions, and return them."""
        self.targets += actions * (self.env_cfg.action_speed_scale * self.sim_dt_s)
        return self.targets.clamp_(self._lower, self._upper)

    def observation_groups(self) -> dict[str, int]:
        """See `compute_bbot_observations`."""
        state = dict.fromkeys(("dof_pos", "dof_vel", "ball_pos", "ball_vel", "sensor_force_x"), 3)
        return state | {"sensor_torques": 9}

    def compute_obs(self) -> Tensor:
        """See `compute_bbot_observations`."""
        sim = self.simulation
        ball = self._ball_states()
        # The wrench (6, N) is in the tray's frame, about the tray's middle.
        wrench = measure_wrenches(self.simulation, ("tray",))
        return compute_bbot_observations(
            sim.dof_pos.index_select(1, self._driven),
            sim.dof_vel.index_select(1, self._driven),
            ball[:, :3],
            ball[:, 7:10],
            wrench[:1].expand(len(self._sensor_points), -1),
            torques_about(wrench, self._sensor_points),
        )

    def _ball_states(self) -> Tensor:
        return self.simulation.object_states[:, self._ball]

    def compute_reward_terms(self) -> Terms:
        """See `compute_bbot_reward`."""
        ball = self._ball_states()
        return compute_bbot_reward(ball[:, :3], ball[:, 7:10])

    def compute_failures(self) -> Tensor:
        """See `compute_bbot_failures`."""
        return compute_bbot_failures(self._ball_states()[:, 2])

    def reset_state(self, env_ids: Tensor) -> None:
        """Reset legs and tray to the model's pose, and draw the ball's state."""
        n = len(env_ids)
        zeros = torch.zeros(n, len(self.simulation.dof_names), device=self.device)
        self.simulation.write_state(env_ids, self.initial_root.repeat(n, 1), zeros, zeros)
        ball = torch.tensor([self._ball], device=self.device)
        self.simulation.write_object_states(env_ids, ball, draw_ball_states(env_ids)[:, None])
        self.targets.index_fill_(0, env_ids, 0.0)
