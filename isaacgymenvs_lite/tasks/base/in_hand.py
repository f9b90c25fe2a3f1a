"""The common parts of ShadowHand and AllegroHand: a hand turns an object to goal after goal.

The formulas come from IsaacGymEnvs. The task keeps these quirks:

- The pen's tilt and spin come from the same random number.
- The goal of a pen is reached at twice the angle of other objects.
- Relative actions move the targets by the time of one simulator call, not of a control step.

Differences from IsaacGymEnvs: a random force acts during the whole control step; there the same
impulse acts within one simulator call. The forces of joints are the torques of drives, springs and
dampers, and the forces on fingertips are contact forces in the frames of the fingertips.
"""

from __future__ import annotations

import logging
import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.rendering.markers import GO_COLOUR, Marker, Solid
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.drives import integrate_drives_implicitly
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.rows import body_rows, dof_rows
from isaacgymenvs_lite.tasks.base.scenes import (
    HAND_BITS,
    Bits,
    Names,
    PositionDrive,
    add_object,
    add_position_drive,
    align_root,
    find_body,
    find_joint,
    prepare_robot,
    topmost,
)
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig, TaskConfig
from isaacgymenvs_lite.tasks.base.vec_task import ActionScaling
from isaacgymenvs_lite.tasks.base.wrenches import add_wrench_sensors, measure_wrenches
from isaacgymenvs_lite.utils.rotations import (
    length,
    quat_apply,
    quat_diff_rad,
    quat_from_angle_axis,
    quat_mul,
    quat_mul_components,
)
from isaacgymenvs_lite.utils.scaling import scale, unscale

log = logging.getLogger(__name__)

OPENAI, FULL_NO_VEL, FULL, FULL_STATE = "openai", "full_no_vel", "full", "full_state"
VEL_SCALE = 0.2
FORCE_SCALE = 10.0
_GOAL_BELOW_START_M = 0.04
_GOAL_IS_DRAWN_AT_M = (-0.2, -0.06, 0.12)  # relative to the goal
_PEN_TILT_RAD = 0.3
_MAX_SPIN_RAD_S = 64.0
_WRENCH_SIZE = 6

_BOX, _ELLIPSOID = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID
_CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE


class HeldObject(NamedTuple):
    """An object: MuJoCo's geom type and size (m), density (kg/m^3), height over the hand (m)."""

    kind: int
    size_m: tuple[float, float, float]
    density: float
    start_above_hand_m: float


EGG = HeldObject(_ELLIPSOID, (0.03, 0.03, 0.04), 1000.0, 0.10)
PEN = HeldObject(_CAPSULE, (0.008, 0.1, 0.0), 1000.0, 0.02)


def block(edge_m: float, density: float, start_above_hand_m: float) -> HeldObject:
    """Return a cube with edges of `edge_m`."""
    half = 0.5 * edge_m
    return HeldObject(_BOX, (half, half, half), density, start_above_hand_m)


@dataclass(frozen=True)
class HandAssetConfig(AssetConfig):
    """`task.env.asset`. The files of the objects have no effect: the objects are built in."""

    block: str = setting("", key="assetFileNameBlock")
    egg: str = setting("", key="assetFileNameEgg")
    pen: str = setting("", key="assetFileNamePen")


@dataclass(frozen=True, kw_only=True)
class HandConfig(TaskConfig):
    """Keys of `task.env` that both hands share."""

    asset: HandAssetConfig = field(default_factory=HandAssetConfig)
    episode_length: int = setting(600, key="episodeLength", minimum=2)  # control steps
    reset_time: float = setting(-1.0, key="resetTime")  # s; above 0 it replaces episode_length
    aggregate_mode: int = setting(1, key="aggregateMode")  # no effect
    object_type: str = setting("block", key="objectType", choices=("block", "egg", "pen"))
    observation_type: str = setting(FULL_STATE, key="observationType")
    use_relative_control: bool = setting(False, key="useRelativeControl")
    dof_speed_scale: float = setting(20.0, key="dofSpeedScale")  # rad/s
    actions_moving_average: float = setting(1.0, key="actionsMovingAverage", minimum=0, maximum=1)
    stiffness_scale: float = setting(1.0, key="stiffnessScale")  # no effect
    force_limit_scale: float = setting(1.0, key="forceLimitScale")  # no effect
    start_position_noise: float = setting(0.01, key="startPositionNoise")  # no effect
    start_rotation_noise: float = setting(0.0, key="startRotationNoise")  # no effect
    reset_position_noise: float = setting(0.01, key="resetPositionNoise", minimum=0)  # m
    reset_rotation_noise: float = setting(0.0, key="resetRotationNoise")  # no effect
    reset_dof_pos_random_interval: float = setting(0.2, key="resetDofPosRandomInterval")
    reset_dof_vel_random_interval: float = setting(0.0, key="resetDofVelRandomInterval")  # rad/s
    force_scale: float = setting(0.0, key="forceScale", minimum=0)  # m/s^2
    force_prob_range: tuple[float, ...] = setting(
        (0.001, 0.1), key="forceProbRange", length=2, minimum=1e-9, maximum=1
    )
    force_decay: float = setting(0.99, key="forceDecay", minimum=0, maximum=1)
    force_decay_interval: float = setting(0.08, key="forceDecayInterval", above=0)  # s
    dist_reward_scale: float = setting(-10.0, key="distRewardScale")
    rot_reward_scale: float = setting(1.0, key="rotRewardScale")
    rot_eps: float = setting(0.1, key="rotEps", above=0)  # rad
    action_penalty_scale: float = setting(-0.0002, key="actionPenaltyScale")
    reach_goal_bonus: float = setting(250.0, key="reachGoalBonus")
    fall_distance: float = setting(0.24, key="fallDistance", above=0)  # m
    fall_penalty: float = setting(0.0, key="fallPenalty")
    success_tolerance: float = setting(0.1, key="successTolerance", minimum=0)  # rad
    max_consecutive_successes: int = setting(0, key="maxConsecutiveSuccesses", minimum=0)
    aver_factor: float = setting(0.1, key="averFactor", minimum=0, maximum=1)
    print_num_successes: bool = setting(False, key="printNumSuccesses")

    @property
    def tolerance_rad(self) -> float:
        """Angle at which a goal is reached."""
        return self.success_tolerance * (2.0 if self.object_type == "pen" else 1.0)


def compute_hand_reward(
    distance: Tensor,
    angle: Tensor,
    actions: Tensor,
    is_reached: Tensor,
    is_late: Tensor,
    cfg: HandConfig,
) -> Terms:
    """Return the reward terms (N,).

    Args:
        distance: (N,) m between object and goal.
        angle: (N,) rad between object and goal.
        actions: (N, A).
        is_reached: (N,) bool, whether the goal is reached.
        is_late: (N,) bool, whether the episode reached its time limit.
        cfg: the scales.
    """
    has_fallen = distance >= cfg.fall_distance
    terms = {
        "distance": cfg.dist_reward_scale * distance,
        "rotation": cfg.rot_reward_scale / (angle.abs() + cfg.rot_eps),
        "action": cfg.action_penalty_scale * actions.square().sum(-1),
        "goal": cfg.reach_goal_bonus * is_reached,
        "fall": cfg.fall_penalty * has_fallen,
    }
    if cfg.max_consecutive_successes > 0:
        terms["late"] = 0.5 * cfg.fall_penalty * is_late
    return terms


def randomize_rotation(
    rand0: Tensor, rand1: Tensor, x_unit_tensor: Tensor, y_unit_tensor: Tensor
) -> Tensor:
    """Return rotations (n, 4) xyzw about y and then x, as in IsaacGymEnvs.

    The random numbers (n,) are in [-1, 1] and mean angles in units of pi. The axes are (n, 3).
    """
    return quat_mul(
        quat_from_angle_axis(rand0 * math.pi, x_unit_tensor),
        quat_from_angle_axis(rand1 * math.pi, y_unit_tensor),
    )


def randomize_rotation_pen(
    rand0: Tensor,
    rand1: Tensor,
    max_angle: float,
    x_unit_tensor: Tensor,
    y_unit_tensor: Tensor,
    z_unit_tensor: Tensor,
) -> Tensor:
    """Return rotations (n, 4) xyzw of lying pens, as in IsaacGymEnvs.

    The pen is tilted by at most `max_angle` (rad). As there, only `rand0` (n,) has an influence.
    """
    return quat_mul(
        quat_from_angle_axis(0.5 * math.pi + rand0 * max_angle, x_unit_tensor),
        quat_from_angle_axis(rand0 * math.pi, z_unit_tensor),
    )


def update_consecutive_successes(
    consecutive_successes: Tensor, successes: Tensor, resets: Tensor, aver_factor: float
) -> Tensor:
    """Return the moving average () of the numbers of successes of episodes.

    `successes` (N,) and `resets` (N,) are the successes of the running episodes, and whether they
    end now.
    """
    ended = resets.bool()
    mean = (successes * ended).sum() / ended.sum().clamp(min=1)
    updated = aver_factor * mean + (1.0 - aver_factor) * consecutive_successes
    return torch.where(ended.any(), updated, consecutive_successes)


class InHandTask(MjcfTask):
    """N hands with an object each. A subclass names joints, drives and fingertips."""

    settings_class = HandConfig
    actor_name = "hand"
    other_actors: ClassVar[dict[str, str]] = {"object": "object"}
    starts_before_physics = True
    max_physics_step_s = 0.0084
    joints: ClassVar[tuple[Names, ...]]
    """The D joints in the order of the observations."""
    drives: ClassVar[dict[int, PositionDrive]]
    """The drives of the actuated joints, by their indices in `joints`, in the actions' order."""
    base_joints: ClassVar[tuple[int, ...]]
    """Indices of the joints by which `align_root` places a user's hand."""
    fingertips: ClassVar[tuple[Names, ...]] = ()
    """The bodies of the fingertips, if they are observed."""
    bits: ClassVar[Bits] = HAND_BITS
    objects: ClassVar[dict[str, HeldObject]]
    """The objects by `task.env.objectType`."""
    start_offset_m: ClassVar[tuple[float, float]]
    """x and y of the object's start."""
    hand_height_m: ClassVar[float] = 0.5
    observation_types: ClassVar[tuple[str, ...]]

    def read_settings(self, env: dict[str, Any]) -> TaskConfig:
        """Return the checked keys of `task.env`."""
        cfg = super().read_settings(env)
        assert isinstance(cfg, HandConfig)
        if cfg.observation_type not in self.observation_types:
            raise ConfigError(
                "task.env.observationType: "
                + unknown("type", cfg.observation_type, self.observation_types)
            )
        return cfg

    def episode_length(self) -> int:
        """Return the number of control steps in an episode."""
        cfg = self.env_cfg
        if cfg.reset_time <= 0.0:
            return cfg.episode_length
        return max(2, round(cfg.reset_time / (cfg.control_freq_inv * self.sim_cfg.dt)))

    def set_sizes(self) -> None:
        """Set the sizes of observations and actions."""
        self.num_actions = len(self.drives)
        self.num_observations = sum(self._parts_of(self.env_cfg.observation_type).values())

    def states_size(self) -> int:
        """Return the size of the privileged observation."""
        return sum(self._parts_of(FULL_STATE).values())

    # --- the model --------------------------------------------------------------------------

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Give the hand drives and sensors, and add the object."""
        # Contacts between fingers sometimes diverge with elliptic cones or a larger tolerance.
        spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
        spec.option.impratio = 1.0
        spec.option.tolerance = 1e-12
        joints = [find_joint(spec, names) for names in self.joints]
        tips = [find_body(spec, names) for names in self.fingertips]
        root = topmost(joints[0].parent)
        prepare_robot(spec, root, self.bits)
        own = mujoco.MjSpec.from_file(str(assets_dir() / self.default_asset))
        if own.joint(joints[0].name) is None:  # a user's file
            bases = [self.joints[number] for number in self.base_joints]
            align_root(spec, root, own, [(find_joint(spec, n), own.joint(n[0])) for n in bases])
        self.joint_names = tuple(joint.name for joint in joints)
        self.tip_names = tuple(tip.name for tip in tips)
        self.change_joints(spec, joints)
        for number, drive in self.drives.items():
            add_position_drive(spec, joints[number], drive)
        integrate_drives_implicitly(spec, self.sim_cfg.dt / self.sim_cfg.substeps)
        add_wrench_sensors(spec, self.tip_names)
        held, (x, y) = self.objects[self.env_cfg.object_type], self.start_offset_m
        self._start_pos = (x, y, self.hand_height_m + held.start_above_hand_m)
        add_object(spec, "object", held.size_m, self._start_pos, held.density, held.kind)

    def build_model(self) -> mujoco.MjModel:
        """Return the compiled model. A drag limits the pen's spin, as PhysX limits all bodies'.

        The gyroscopic torque of a body as thin as the pen otherwise makes a fast spin faster and
        faster at these time steps.
        """
        model = super().build_model()
        if self.env_cfg.object_type == "pen":
            pen = model.body("object")
            spins = slice(pen.dofadr[0] + 3, pen.dofadr[0] + 6)
            drag = pen.inertia.max() / (model.opt.timestep * _MAX_SPIN_RAD_S**2)
            model.dof_dampingpoly[spins, 1] = drag  # of the third power
        return model

    @abstractmethod
    def change_joints(self, spec: mujoco.MjSpec, joints: Sequence[mujoco.MjsJoint]) -> None:
        """Set the properties of the D joints, and add tendons."""

    def create_sim(self) -> None:
        """Create the simulations and look up joints, fingertips and the object."""
        super().create_sim()
        sim, device = self.simulation, self.device
        self._dofs, self._lower, self._upper = self.find_joints(self.joint_names)
        self._driven = torch.tensor(tuple(self.drives), device=device)
        tips = [sim.body_names.index(name) for name in self.tip_names]
        self._tips = torch.tensor(tips, device=device, dtype=torch.int64)
        self.start_pos = torch.tensor(self._start_pos, device=device)
        self.object_mass_kg = float(self._model.body("object").mass[0])

    def allocate_buffers(self) -> None:
        """Add targets, goals, forces and counts of successes."""
        super().allocate_buffers()
        n, device, cfg = self.num_envs, self.device, self.env_cfg
        self.prev_targets = torch.zeros(n, len(self.joints), device=device)  # rad
        self.goal_pos = self.start_pos - torch.tensor(
            (0.0, 0.0, _GOAL_BELOW_START_M), device=device
        )
        self.goal_rot = torch.zeros(4, n, device=device).t()  # (N, 4) xyzw
        self.goal_rot[:, 3] = 1.0
        self.reset_goal_buf = torch.ones(n, dtype=torch.bool, device=device)
        self.successes = torch.zeros(n, device=device)
        self.consecutive_successes = torch.zeros((), device=device)
        self.object_forces = torch.zeros(n, 3, device=device)  # newton, in the object's frame
        self.force_prob = torch.zeros(n, device=device)
        self._decay = cfg.force_decay ** (self.sim_dt_s / cfg.force_decay_interval)
        self._num_resets = self._num_counted = 0.0

    # --- a step -----------------------------------------------------------------------------

    def pre_physics_step(self, actions: Tensor) -> None:
        """Draw new goals and start episodes, then set targets and random forces."""
        self._draw_goals(self.reset_goal_buf.nonzero().flatten())
        super().pre_physics_step(actions)
        if self.env_cfg.force_scale > 0.0:
            self._push_objects()

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the position targets (N, A) in rad of the actuated joints."""
        cfg, driven = self.env_cfg, self._driven
        before = self.prev_targets.index_select(1, driven)
        lower, upper = self._lower[driven], self._upper[driven]
        if cfg.use_relative_control:
            targets = before + cfg.dof_speed_scale * self.sim_dt_s * actions
        else:
            share = cfg.actions_moving_average
            targets = share * scale(actions, lower, upper) + (1.0 - share) * before
        targets = targets.clamp(lower, upper)
        self.prev_targets.index_copy_(1, driven, targets)
        return targets

    def action_scaling(self) -> ActionScaling | None:
        """Return the position targets of absolute actions that are not averaged."""
        if self.env_cfg.use_relative_control or self.env_cfg.actions_moving_average < 1.0:
            return None
        lower, upper = self._lower[self._driven], self._upper[self._driven]
        return ActionScaling("rad", 0.5 * (upper + lower), 0.5 * (upper - lower))

    def _push_objects(self) -> None:
        self.object_forces *= self._decay
        is_pushed = torch.rand(self.num_envs, device=self.device) < self.force_prob
        newton = self.object_mass_kg * self.env_cfg.force_scale
        fresh = newton * torch.randn(self.num_envs, 3, device=self.device)
        self.object_forces = torch.where(is_pushed[:, None], fresh, self.object_forces)
        forces_w = quat_apply(self._object()[:, 3:7], self.object_forces / self.control_freq_inv)
        self.simulation.apply_forces(("object",), forces_w[:, None])

    def update_state(self) -> None:
        """Compare the objects with their goals, and count the goals that are reached."""
        state, cfg = self._object(), self.env_cfg
        self.goal_distance = length(state[:, :3] - self.goal_pos)
        self.goal_angle = quat_diff_rad(state[:, 3:7], self.goal_rot)
        is_near = (self.goal_angle.abs() <= cfg.tolerance_rad) & ~self.diverged_buf
        self.reset_goal_buf |= is_near
        self.successes += self.reset_goal_buf
        if cfg.max_consecutive_successes > 0:
            self.progress_buf.masked_fill_(is_near, 0)

    def compute_reward_terms(self) -> Terms:
        """See `compute_hand_reward`."""
        return compute_hand_reward(
            self.goal_distance,
            self.goal_angle,
            self.actions,
            self.reset_goal_buf,
            self.compute_time_outs(),
            self.env_cfg,
        )

    def compute_failures(self) -> Tensor:
        """Return where (N,) the object has fallen."""
        return self.goal_distance >= self.env_cfg.fall_distance

    def compute_reached(self) -> Tensor | None:
        """Return where (N,) `maxConsecutiveSuccesses` is reached; 0 means no largest number."""
        most = self.env_cfg.max_consecutive_successes
        return self.successes >= most if most > 0 else None

    def episode_successes(self) -> dict[str, Tensor]:
        """Return the numbers (N,) of goals that the running episodes reached."""
        return {"consecutive_successes": self.successes}

    def compute_reset(self) -> None:
        """Write which episodes end and why; average the successes of ended episodes."""
        super().compute_reset()
        self.consecutive_successes = update_consecutive_successes(
            self.consecutive_successes, self.successes, self.reset_buf, self.env_cfg.aver_factor
        )
        if self.env_cfg.print_num_successes and bool(self.reset_buf.any()):
            self._log_successes()

    def _log_successes(self) -> None:
        self._num_resets += float(self.reset_buf.sum())
        running = self._num_counted + float(self.successes.sum())
        self._num_counted += float((self.successes * self.reset_buf).sum())
        log.info(
            "mean goals of an episode: %.1f with running episodes, %.1f of ended episodes",
            running / (self._num_resets + self.num_envs),
            self._num_counted / self._num_resets,
        )

    def infos(self) -> dict[str, Any]:
        """Return the moving average of the successes of episodes."""
        return {"consecutive_successes": self.consecutive_successes}

    # --- observations -----------------------------------------------------------------------

    def _object(self) -> Tensor:
        """Return the states (N, 13) of the objects."""
        return self.simulation.object_states[:, 0]

    def _parts_of(self, observation_type: str) -> dict[str, int]:
        """Return the ordered names and sizes of the parts of an observation."""
        dofs, actions, tips = len(self.joints), len(self.drives), len(self.fingertips)
        sizes = {
            "dof_pos": dofs,
            "dof_vel": dofs,
            "dof_force": dofs,
            "object_pose": 7,
            "object_pos": 3,
            "object_lin_vel": 3,
            "object_ang_vel": 3,
            "goal_pose": 7,
            "goal_relative_rot_xyzw": 4,
            "fingertip_pos": 3 * tips,
            "fingertip_states": 13 * tips,
            "fingertip_wrenches": _WRENCH_SIZE * tips,
            "last_actions": actions,
        }
        names = {
            OPENAI: ("fingertip_pos", "object_pos", "goal_relative_rot_xyzw", "last_actions"),
            FULL_NO_VEL: (
                *("dof_pos", "object_pose", "goal_pose", "goal_relative_rot_xyzw"),
                *("fingertip_pos", "last_actions"),
            ),
            FULL: (
                *("dof_pos", "dof_vel", "object_pose", "object_lin_vel", "object_ang_vel"),
                *("goal_pose", "goal_relative_rot_xyzw", "fingertip_states", "last_actions"),
            ),
            FULL_STATE: (
                *("dof_pos", "dof_vel", "dof_force"),
                *("object_pose", "object_lin_vel", "object_ang_vel", "goal_pose"),
                *("goal_relative_rot_xyzw", "fingertip_states", "fingertip_wrenches"),
                "last_actions",
            ),
        }[observation_type]
        return {name: sizes[name] for name in names if sizes[name] > 0}

    def observation_groups(self) -> dict[str, int]:
        """Return the parts of the observation.

        Joint positions are scaled from their limits to [-1, 1]. Velocities of joints and angular
        velocities of the object are scaled by 0.2, forces and torques by 10. Fingertip states have
        position, rotation xyzw, linear and angular velocity of each fingertip.
        """
        return self._parts_of(self.env_cfg.observation_type)

    def compute_obs(self) -> Tensor:
        """See `observation_groups`."""
        return self._observe(self.env_cfg.observation_type)

    def compute_states(self, env_ids: Tensor | None, observations: Tensor) -> Tensor:
        """Return the observation of the type `full_state`, without noise."""
        if self.env_cfg.observation_type == FULL_STATE:
            return observations
        states = self._observe(FULL_STATE)
        return states if env_ids is None else states.index_select(0, env_ids)

    def _observe(self, observation_type: str) -> Tensor:
        sim, held, goal_rot = self.simulation, self._object().t(), self.goal_rot.t()
        joints, tips = self._dofs, self._tips
        lower, upper = self._lower[:, None], self._upper[:, None]
        rows: dict[str, Callable[[], Tensor]] = {
            "dof_pos": lambda: unscale(dof_rows(joints, sim.dof_pos), lower, upper),
            "dof_vel": lambda: VEL_SCALE * dof_rows(joints, sim.dof_vel),
            "dof_force": lambda: FORCE_SCALE * dof_rows(joints, sim.dof_forces),
            "object_pose": lambda: held[:7],
            "object_pos": lambda: held[:3],
            "object_lin_vel": lambda: held[7:10],
            "object_ang_vel": lambda: VEL_SCALE * held[10:],
            "goal_pose": lambda: torch.cat(
                (self.goal_pos[:, None].expand(3, self.num_envs), goal_rot)
            ),
            "goal_relative_rot_xyzw": lambda: torch.stack(
                quat_mul_components(held[3:7], (*-goal_rot[:3], goal_rot[3]))
            ),
            "fingertip_pos": lambda: body_rows(tips, sim.body_pos),
            "fingertip_states": lambda: body_rows(
                tips, sim.body_pos, sim.body_rot, sim.body_lin_vel, sim.body_ang_vel
            ),
            "fingertip_wrenches": lambda: FORCE_SCALE * measure_wrenches(sim, self.tip_names),
            "last_actions": lambda: self.actions.t(),
        }
        return torch.cat([rows[name]() for name in self._parts_of(observation_type)]).t()

    # --- goals and starts -------------------------------------------------------------------

    def _draw_goals(self, env_ids: Tensor) -> None:
        """Draw the rotations of the goals in environments (n,)."""
        if len(env_ids) > 0:
            self.goal_rot.index_copy_(0, env_ids, self._draw_rotations(env_ids))
            self.reset_goal_buf.index_fill_(0, env_ids, False)

    def _draw_rotations(self, env_ids: Tensor, of_pen: bool = False) -> Tensor:
        x, y, z = torch.eye(3, device=self.device)[:, None].expand(3, len(env_ids), 3)
        rand0, rand1 = uniform(env_ids, -1.0, 1.0, (2,)).unbind(-1)
        if of_pen:
            return randomize_rotation_pen(rand0, rand1, _PEN_TILT_RAD, x, y, z)
        return randomize_rotation(rand0, rand1, x, y)

    def reset_state(self, env_ids: Tensor) -> None:
        """Draw goals, positions of the joints, and poses of the objects."""
        cfg, sim, n = self.env_cfg, self.simulation, len(env_ids)
        self._draw_goals(env_ids)
        share = uniform(env_ids, 0.0, 1.0, (len(self.joints),))
        pos = self._lower + (self._upper - self._lower) * share
        pos *= cfg.reset_dof_pos_random_interval
        speed = cfg.reset_dof_vel_random_interval
        vel = uniform(env_ids, -speed, speed, (len(self.joints),))
        dof_pos = torch.zeros(n, len(sim.dof_names), device=self.device)
        dof_vel = torch.zeros_like(dof_pos)
        dof_pos[:, self._dofs], dof_vel[:, self._dofs] = pos, vel
        sim.write_state(env_ids, torch.zeros(n, 13, device=self.device), dof_pos, dof_vel)
        states = torch.zeros(n, 1, 13, device=self.device)
        noise = cfg.reset_position_noise
        states[:, 0, :3] = self.start_pos + uniform(env_ids, -noise, noise, (3,))
        states[:, 0, 3:7] = self._draw_rotations(env_ids, cfg.object_type == "pen")
        sim.write_object_states(env_ids, torch.zeros(1, dtype=torch.int64), states)
        self.prev_targets.index_copy_(0, env_ids, pos)
        self.successes.index_fill_(0, env_ids, 0.0)
        self.object_forces.index_fill_(0, env_ids, 0.0)
        low, high = cfg.force_prob_range
        exponent = uniform(env_ids, math.log(low), math.log(high))
        self.force_prob.index_copy_(0, env_ids, exponent.exp())

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return the goal, beside the hand."""
        held = self.objects[self.env_cfg.object_type]
        x, y, z = (self.goal_pos + torch.tensor(_GOAL_IS_DRAWN_AT_M)).tolist()
        i, j, k, w = self.goal_rot[env_id].tolist()
        return (Solid(held.kind, held.size_m, (x, y, z), (w, i, j, k), GO_COLOUR),)
