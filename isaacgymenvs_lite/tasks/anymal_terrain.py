"""AnymalTerrain: ANYmal C walks over rough ground with a curriculum, as in IsaacGymEnvs.

The task keeps three quirks. Joint positions are observed without subtracting the default angles. A
robot that masters the last level starts again at the first level. The heading command is zero where
the velocity command is zero.

Three more quirks are optional. `control.extraSimulatorCall` adds a fifth simulator call to the four
calls of a control step. `learn.airTimeAsPublished` counts only a quarter of the time that a foot is
in the air. `terrain.demotionAsPublished` lets the commands of other robots decide which level a
robot goes back to.

Other quirks are removed. The task reports time-outs. First observations contain no quantities of
the previous episode. `learn.pushRobots=False` turns pushes off. Joint speeds are not limited to 20
rad/s. Vertical walls are slopes over 0.1 m, because the ground is a height field.

`env.controlFrequencyInv` multiplies the duration of a control step. In IsaacGymEnvs it instead adds
simulator calls that keep the last torque and that the duration of a control step ignores.

The PD controller is a drive of the model. Euler's method computes the drive's torque from positions
and velocities at the start of a simulator call. IsaacGymEnvs computes the same torque in Python
before each call. The torque is limited to 80 Nm.
"""

from __future__ import annotations

import logging
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks.anymal_terrain_terms import (
    NUM_POINTS,
    TERM_NAMES,
    AnymalTerrainConfig,
    HeightScan,
    WalkStep,
    compute_air_time,
    compute_anymal_terrain_observations,
    compute_anymal_terrain_reward,
    noise_widths,
)
from isaacgymenvs_lite.tasks.base.pushes import push_interval, set_planar_velocities
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.vec_task import Done
from isaacgymenvs_lite.tasks.base.velocity_tracking import (
    CONTACT_THRESHOLD_N,
    VelocityTrackingTask,
    clip_negative_total,
)
from isaacgymenvs_lite.tasks.randomization.properties import make_property
from isaacgymenvs_lite.tasks.terrain.grid import Curriculum, add_height_field, make_terrain
from isaacgymenvs_lite.utils.rotations import calc_heading, normalize_angle

log = logging.getLogger(__name__)

_START_OFFSET_M = 0.5
_PUSH_M_S = 1.0
_FRICTION_BUCKETS = 100
_LEAST_COMMAND_M_S = 0.25  # slower commands count as zero
_YAW_RATE_PER_RAD = 0.5  # 1/s
_MAX_YAW_RATE_RAD_S = 1.0
_YAW_RATE, _HEADING = 2, 3


class AnymalTerrain(VelocityTrackingTask):
    """N robots with 188 observations and 12 joint position targets.

    All environments share one ground and one world frame. If episodes end in a step,
    `infos["episode"]` holds their mean reward terms as `rew_<term>` and the mean level of all
    robots as `terrain_level`. Each term is summed over its episode and divided by the duration of
    the longest possible episode (s).

    Attributes:
        terrain: the ground.
        curriculum: the tile of each robot.
        commands: (N, 4) velocities along x and y of the base (m/s), yaw rate (rad/s), and heading
            (rad). The yaw rate is computed from the heading.
    """

    settings_class = AnymalTerrainConfig
    default_asset = "mjcf/anymal_minimal.xml"
    published_assets = ("urdf/anymal_c/urdf/anymal_minimal.urdf",)
    actor_name = "anymal"
    num_observations = 188
    num_actions = 12
    num_commands = 4

    @property
    def control_dt_s(self) -> float:
        """Nominal time of a control step (s)."""
        control = self.env_cfg.control
        return self.sim_cfg.dt * control.decimation * self.env_cfg.control_freq_inv

    def episode_length(self) -> int:
        """Return the number of control steps in `episodeLength_s`."""
        return int(self.env_cfg.learn.episode_length_s / self.control_dt_s + 0.5)

    def simulator_calls(self) -> int:
        """Return the number of simulator calls of `sim.dt` in a control step."""
        control = self.env_cfg.control
        return control.decimation * self.env_cfg.control_freq_inv + int(control.extra_call)

    def _friction(self) -> float:
        return self.env_cfg.terrain.dynamic_friction

    def build_model(self) -> mujoco.MjModel:
        """Create the ground, and return the compiled model with the ground."""
        # The run's seed determines torch's generator, and therefore the ground.
        rng = np.random.default_rng(int(torch.randint(2**31, ()).item()))
        self.terrain = make_terrain(self.env_cfg.terrain, rng)
        return super().build_model()

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Set the drive gains and add the ground."""
        super().change_spec(spec)
        if self.env_cfg.terrain.terrain_type == "plane":
            return
        if spec.geom("floor") is None:
            raise ConfigError("task.env.urdfAsset.file: the model has no geom 'floor'")
        add_height_field(spec, self.terrain)

    def create_sim(self) -> None:
        """Create the simulations, the height scan and the curriculum."""
        super().create_sim()
        self.dt = self.control_dt_s
        learn = self.env_cfg.learn
        self._scan = HeightScan(self.terrain, self.device)
        self.curriculum = Curriculum(self.env_cfg.terrain, self.terrain, self.num_envs, self.device)
        if learn.randomize_friction:
            self._draw_friction(*learn.friction_range)
        self._noise_widths = noise_widths(learn).to(self.device)
        self._air_time_dt = self.sim_cfg.dt if learn.air_time_as_published else self.control_dt_s
        self.push_interval = push_interval(learn.push_interval_s, self.control_dt_s)

    def _draw_friction(self, low: float, high: float) -> None:
        """Assign one of a hundred random friction coefficients to each robot."""
        buckets = low + (high - low) * torch.rand(_FRICTION_BUCKETS)
        values = buckets[torch.arange(self.num_envs) % _FRICTION_BUCKETS].double().numpy()
        bodies = np.arange(1, 1 + len(self._layout.body_names))
        friction = make_property(
            self.simulation, self._layout, bodies, "rigid_shape_properties", "friction"
        )
        if friction is not None:
            shapes = len(friction.original)
            friction.write(np.arange(self.num_envs), np.repeat(values[:, None], shapes, axis=1))

    def allocate_buffers(self) -> None:
        """Add the state that the task keeps between steps."""
        super().allocate_buffers()
        n, device = self.num_envs, self.device
        self.last_actions = torch.zeros_like(self.actions)
        self._last_dof_vel = torch.zeros(len(self.default_dof_pos), n, device=device)
        self.air_time_s = torch.zeros(len(self._foot_ids), n, device=device)
        self._reward_sums = torch.zeros(len(TERM_NAMES), n, device=device)
        self._episode: dict[str, Tensor] = {}
        self._final_observations: dict[str, Tensor] = {}

    def pre_physics_step(self, actions: Tensor) -> None:
        """Store the previous action and joint velocities, then set the joint position targets."""
        self._start_episodes()  # `reset` may not have been called
        self.last_actions = self.actions
        self._last_dof_vel.copy_(self.simulation.dof_vel.t())
        super().pre_physics_step(actions)

    def post_physics_step(self) -> None:
        """Compute the reward, start new episodes, and compute the observation."""
        self.extras.clear()
        self.progress_buf += 1
        self.randomize_buf += 1
        self.update_state()
        self.compute_reset()
        self.compute_reward()
        if self.keeps_final_observations and self.reset_buf.any():
            self.compute_observations()
            self._final_observations = self._observations()
            if self._discarded is not None:
                self._repeat_observations(self._final_observations)
        self._start_episodes()
        self.compute_observations()

    def final_observations(self) -> dict[str, Tensor]:
        """See `VecTask.final_observations`."""
        return self._final_observations

    def update_state(self) -> None:
        """Read contacts, apply pushes that are due, and update the commanded yaw rates."""
        super().update_state()
        sim = self.simulation
        forces = sim.contact_forces.permute(2, 1, 0)
        self._base_in_contact = forces[:, 0].square().sum(0) > CONTACT_THRESHOLD_N**2
        self._knees_in_contact = self.in_contact(self._knee_ids)
        self._foot_forces = forces.index_select(1, self._foot_ids)
        self.air_time_s, self._air_time_beyond_s = compute_air_time(
            self.air_time_s, self._foot_forces[2] > CONTACT_THRESHOLD_N, self._air_time_dt
        )
        self._episode = {}
        if self.env_cfg.learn.push_robots and (self.control_steps + 1) % self.push_interval == 0:
            # A push clears the contact forces, so the forces are read before the push.
            velocities_w = uniform(self.reset_buf, -_PUSH_M_S, _PUSH_M_S, (2,))
            set_planar_velocities(sim, velocities_w)
        self._steer()

    def _steer(self) -> None:
        """Compute the yaw rate commands from the heading commands."""
        heading = calc_heading(self.simulation.root_states[:, 3:7])
        error = normalize_angle(self._command_planes[_HEADING] - heading)
        rate = error.mul_(_YAW_RATE_PER_RAD).clamp_(-_MAX_YAW_RATE_RAD_S, _MAX_YAW_RATE_RAD_S)
        self._command_planes[_YAW_RATE] = rate

    def observation_groups(self) -> dict[str, int]:
        """See `compute_anymal_terrain_observations`."""
        own, last = self.proprioception_groups(), {"last_actions": self.num_actions}
        return own | {"ground_heights": NUM_POINTS} | last

    def compute_obs(self) -> Tensor:
        """See `compute_anymal_terrain_observations`."""
        sim = self.simulation
        root = sim.root_states
        return compute_anymal_terrain_observations(
            self.base_motion(),
            self._command_planes,
            sim.dof_pos.t(),
            sim.dof_vel.t(),
            root[:, 2],
            self._scan(root[:, :3], root[:, 3:7]),
            self.actions.t(),
            self.env_cfg.learn,
        )

    def add_sensor_noise(self, observations: Tensor) -> Tensor:
        """Add noise to observations (n, 188), and return the sums."""
        if not self.env_cfg.learn.add_noise:
            return observations
        noise = torch.rand_like(observations).mul_(2.0).sub_(1.0)
        return noise.mul_(self._noise_widths).add_(observations)

    def compute_reward_terms(self) -> Terms:
        """Return the reward terms (N,). Without the term `terminal`, their sum is at least 0."""
        sim, learn, step_s = self.simulation, self.env_cfg.learn, self.control_dt_s
        step = WalkStep(
            motion=self.base_motion(),
            commands=self._command_planes,
            base_height=sim.root_states[:, 2],
            dof_offset=(sim.dof_pos - self.default_dof_pos).t(),
            dof_vel=sim.dof_vel.t(),
            last_dof_vel=self._last_dof_vel,
            torques=self._torques,
            actions=self.actions.t(),
            last_actions=self.last_actions.t(),
            knees_in_contact=self._knees_in_contact,
            foot_forces=self._foot_forces,
            air_time_beyond_s=self._air_time_beyond_s,
        )
        terms = compute_anymal_terrain_reward(step, learn, step_s)
        self._reward_sums += torch.stack([terms[name] for name in TERM_NAMES])
        return {
            **clip_negative_total(terms),
            "terminal": (self.done_buf == Done.FAILED) * (learn.terminal_reward * step_s),
        }

    def compute_failures(self) -> Tensor:
        """Return where (N,) the base or, if `allowKneeContacts` is False, a knee is in contact."""
        if self.env_cfg.learn.allow_knee_contacts:
            return self._base_in_contact
        return self._base_in_contact | self._knees_in_contact.any(0)

    def infos(self) -> dict[str, Any]:
        """Return the means of the ended episodes (see the class docstring)."""
        return {"episode": self._episode} if self._episode else {}

    def reset_state(self, env_ids: Tensor) -> None:
        """Place the robots on their tiles, draw commands, and clear sums and timers."""
        self._conclude(env_ids)
        root = self._start_root + torch.zeros(len(env_ids), 1, device=self.device)
        root[:, :3] += self.curriculum.origins(env_ids)
        root[:, :2] += uniform(env_ids, -_START_OFFSET_M, _START_OFFSET_M, (2,))
        self.simulation.write_state(env_ids, root, *self.draw_start_joints(env_ids))
        along, aside, heading = commands = self.draw_commands(env_ids)
        commands *= torch.hypot(along, aside) > _LEAST_COMMAND_M_S
        commands = torch.stack((along, aside, torch.zeros_like(along), heading))
        self._command_planes.index_copy_(1, env_ids, commands)
        self.actions.index_fill_(0, env_ids, 0.0)
        self.air_time_s.index_fill_(1, env_ids, 0.0)
        self._reward_sums.index_fill_(1, env_ids, 0.0)
        self._motion = None
        self._steer()

    def _conclude(self, env_ids: Tensor) -> None:
        """Update the levels and `infos["episode"]` for episodes that ended in this step."""
        ended = (self.done_buf != Done.RUNNING) & (self.progress_buf > 0)
        # The position of a diverged robot is invalid.
        ended &= ~self.simulation.failed
        env_ids = env_ids[ended[env_ids]]
        if len(env_ids) == 0:
            return
        longest_s = self.env_cfg.learn.episode_length_s
        root_pos = self.simulation.root_states[env_ids, :3]
        self.curriculum.update(env_ids, root_pos, self.commands[env_ids, :2], longest_s)
        rates = self._reward_sums[:, env_ids].mean(dim=1) / longest_s
        self._episode = {
            **{f"rew_{name}": rate for name, rate in zip(TERM_NAMES, rates, strict=True)},
            "terrain_level": self.curriculum.levels.float().mean(),
        }

    def get_env_state(self) -> dict[str, Tensor]:
        """Return the levels (N,) of the robots, which a resumed training continues with."""
        return {"terrain_levels": self.curriculum.levels.clone()}

    def set_env_state(self, env_state: Any) -> None:
        """Restore the levels if the ground and the number of robots are the same."""
        levels = env_state.get("terrain_levels") if isinstance(env_state, dict) else None
        if levels is None:
            return
        own, num_levels = self.curriculum.levels, self.terrain.origins.shape[0]
        fits = isinstance(levels, Tensor) and (levels.shape, levels.dtype) == (own.shape, own.dtype)
        if not fits or not bool(((levels >= 0) & (levels < num_levels)).all()):
            log.info("the checkpoint's terrain levels do not fit this ground or number of robots")
            return
        own.copy_(levels)
