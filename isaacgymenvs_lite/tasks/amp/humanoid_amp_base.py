"""HumanoidAMPBase: the simulated humanoid of AMP without a notion of reference motion."""

from __future__ import annotations

import logging
from typing import Any, ClassVar

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.simulation.backend import make_simulation
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import (
    OWN_ASSET,
    HumanoidAMPConfig,
    read_env_config,
)
from isaacgymenvs_lite.tasks.amp.humanoid_model import build_model, dof_limits
from isaacgymenvs_lite.tasks.base.action_scaling import ActionScaling
from isaacgymenvs_lite.tasks.base.assets import shipped_assets
from isaacgymenvs_lite.tasks.base.humanoid_observations import (
    compute_humanoid_observations,
    compute_humanoid_reset,
    compute_humanoid_reward,
    dof_to_obs,
    num_humanoid_obs,
    pd_action_offset_scale,
)
from isaacgymenvs_lite.tasks.base.task_config import SimConfig, read_sim_config
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

__all__ = [
    "DOF_BODY_IDS",
    "DOF_OFFSETS",
    "KEY_BODY_NAMES",
    "NUM_ACTIONS",
    "NUM_OBS",
    "HumanoidAMPBase",
    "compute_humanoid_observations",
    "compute_humanoid_reset",
    "compute_humanoid_reward",
    "dof_to_obs",
]

log = logging.getLogger(__name__)

# What IsaacGymEnvs says of its humanoid, for scripts; a task here asks its model.
DOF_BODY_IDS = [1, 2, 3, 4, 6, 7, 9, 10, 11, 12, 13, 14]
DOF_OFFSETS = [0, 3, 6, 9, 10, 13, 14, 17, 18, 21, 24, 25, 28]
NUM_OBS = 105
NUM_ACTIONS = 28
KEY_BODY_NAMES = ("right_hand", "left_hand", "right_foot", "left_foot")
_START_HEIGHT_M = 0.89

CharacterState = tuple[Tensor, Tensor, Tensor, Tensor]
"""Root states (..., 13), DOF positions and velocities (..., D), key body positions (..., K, 3)."""


# On tensors of a few kB the bookkeeping of autograd is a tenth of an operation, and nothing here is
# ever differentiated: hence inference_mode where results are copied into buffers.


class HumanoidAMPBase(VecTask):
    """N humanoids driven by PD targets (or torques); 105 observations, 28 actions.

    Differs from IsaacGymEnvs (each named in docs/amp.md): falls count contact forces in any
    direction; the observation after a reset is that of the new state; the default pose is the
    zero pose (the original's crosses the arms in front of the chest).

    Raises:
        ConfigError: a key or value of `task.env` or `task.sim` that cannot be used.
    """

    def __init__(
        self,
        cfg: dict[str, Any],
        rl_device: str,
        sim_device: str,
        graphics_device_id: int,
        headless: bool,
        virtual_screen_capture: bool = False,
        force_render: bool = False,
    ) -> None:
        self.sim_cfg: SimConfig = read_sim_config(cfg["sim"])
        self.env_cfg: Any = self._read_env_config(cfg["env"])
        # Sizes are the model's, and the base class wants them first.
        self._model = self._build_model()
        self._layout = ModelLayout.from_model(self._model)
        cfg["env"]["numObservations"] = self._obs_size()
        cfg["env"]["numActions"] = self._layout.num_dofs
        cfg["env"].setdefault("clipActions", self.env_cfg.clip_actions)
        cfg["env"].setdefault("controlFrequencyInv", self.env_cfg.control_freq_inv)
        super().__init__(
            cfg,
            rl_device,
            sim_device,
            graphics_device_id,
            headless,
            virtual_screen_capture,
            force_render,
        )
        self.max_episode_length = self.env_cfg.episode_length
        # Control period: history, demonstrations and velocities of the task count in it.
        self.dt = self.env_cfg.control_freq_inv * self.sim_cfg.dt

    resets_on_request = True
    actor_name = "humanoid"

    # --- what a kind of humanoid says of itself ---------------------------------------------

    num_dofs_of_assets: ClassVar[tuple[int, ...]] = (NUM_ACTIONS,)

    def _read_env_config(self, env: dict[str, Any]) -> HumanoidAMPConfig:
        return read_env_config(env)

    def _build_model(self) -> mujoco.MjModel:
        return build_model(self.env_cfg, self.sim_cfg)

    def _obs_size(self) -> int:
        return num_humanoid_obs(self._layout.dof_offsets, len(self._key_body_names()))

    def _key_body_names(self) -> tuple[str, ...]:
        return KEY_BODY_NAMES

    def observation_groups(self) -> dict[str, int]:
        """See `compute_humanoid_observations`."""
        num_dofs, num_keys = self._layout.num_dofs, len(self._key_body_names())
        root = {"root_height": 1, "root_rot_tan_norm": 6, "root_lin_vel": 3, "root_ang_vel": 3}
        joints = self.num_obs - sum(root.values()) - num_dofs - 3 * num_keys
        return root | {"dof_pos": joints, "dof_vel": num_dofs, "key_body_pos": 3 * num_keys}

    def action_scaling(self) -> ActionScaling:
        """Return targets of the drives in rad, or torques in Nm without `pdControl`."""
        unit = "rad" if self.env_cfg.pd_control else "Nm"
        return ActionScaling(unit, self._action_offset, self._action_scale)

    def _pd_offset_scale(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Return offset and scale (D,) of PD targets for joint limits (D,), rad."""
        return pd_action_offset_scale(lower, upper, self._layout.dof_offsets)

    # --- construction -----------------------------------------------------------------------

    def create_sim(self) -> None:
        """Make the N simulations of the model."""
        self._check_asset()
        physx = self.cfg["sim"].get("physx") or {}
        self.simulation = make_simulation(
            self._model,
            self.num_envs,
            substeps=self.sim_cfg.substeps * self.env_cfg.control_freq_inv,
            num_threads=int(physx.get("num_threads", 0)),
        )
        self._contact_body_ids = self._body_ids("contactBodies", self.env_cfg.contact_bodies)
        self._key_body_ids = self._body_ids("keyBodies", self._key_body_names())
        self._termination_heights_m = self._termination_heights()
        self._build_action_scaling()

    def _check_asset(self) -> None:
        num_dofs, num_actuators = self._layout.num_dofs, self._model.nu
        if num_dofs not in self.num_dofs_of_assets or num_actuators != num_dofs:
            expected = " or ".join(str(n) for n in self.num_dofs_of_assets)
            name = self.env_cfg.asset.asset_file_name or OWN_ASSET
            raise ConfigError(
                f"task.env.asset.assetFileName='{name}' has"
                f" {num_dofs} degrees of freedom and {num_actuators} actuators;"
                f" {type(self).__name__} expects {expected} of both ({shipped_assets()})"
            )

    def _termination_heights(self) -> float | Tensor:
        """Return the height (m) below which a touched body means a fall, one or one per body."""
        return self.env_cfg.termination_height

    def _body_ids(self, key: str, names: tuple[str, ...]) -> Tensor:
        known = self.simulation.body_names
        for name in names:
            if name not in known:
                raise ConfigError(unknown(f"body in task.env.{key}:", name, known))
        ids = [known.index(name) for name in names]
        return torch.tensor(ids, dtype=torch.int64, device=self.device)

    def _build_action_scaling(self) -> None:
        """Offset and scale (D,) from actions to controls: PD targets in rad or torques in Nm."""
        efforts = torch.tensor(self._model.actuator_forcerange[:, 1], dtype=torch.float32)
        self.motor_efforts = efforts.to(self.device)
        if not self.env_cfg.pd_control:
            self._action_offset = torch.zeros_like(self.motor_efforts)
            self._action_scale = self.motor_efforts * self.env_cfg.power_scale
            return
        limits = torch.from_numpy(dof_limits(self._model, self._layout)).float()
        offset, scale = self._pd_offset_scale(limits[:, 0], limits[:, 1])
        self._action_offset, self._action_scale = offset.to(self.device), scale.to(self.device)

    def allocate_buffers(self) -> None:
        """Add the buffer of falls; it starts at 1, as in IsaacGymEnvs."""
        super().allocate_buffers()
        self._terminate_buf = torch.ones_like(self.reset_buf)

    # --- step ------------------------------------------------------------------------------

    def pre_physics_step(self, actions: Tensor) -> None:
        """Set PD targets offset + scale * action (rad), or torques (Nm)."""
        self._set_targets(actions)

    def _set_targets(self, actions: Tensor) -> None:
        controls = torch.addcmul(self._action_offset, self._action_scale, actions)
        self.simulation.set_controls(controls)

    def post_physics_step(self) -> None:
        """Count the step; observe; reward; end episodes at falls and at the time limit."""
        self.progress_buf += 1
        self.randomize_buf += 1
        self.compute_observations()
        self.rew_buf.copy_(self._task_reward())
        self.compute_reset()
        self.extras["terminate"] = self._for_trainer(self._terminate_buf)

    def _task_reward(self) -> Tensor:
        return compute_humanoid_reward(self.obs_buf)

    def _observe(self, env_ids: Tensor | None) -> Tensor:
        """Return the observations of all environments, or of `env_ids` (n,)."""
        return compute_humanoid_observations(
            *self._features_source(env_ids), self.env_cfg.local_root_obs
        )

    @torch.inference_mode()
    def compute_observations(self, env_ids: Tensor | None = None) -> None:
        """Write the observation of all environments, or of `env_ids` (n,), into `obs_buf`."""
        features = self._observe(env_ids)
        if env_ids is None:
            self.obs_buf.copy_(features)
        else:
            self.obs_buf.index_copy_(0, env_ids, features)

    def _features_source(self, env_ids: Tensor | None) -> CharacterState:
        """Root states, DOF positions and velocities, key body positions of (n,) or all."""
        sim = self.simulation
        # By components first: planes stay planes (see `SimulationBackend`).
        key_body_pos = sim.body_pos.permute(2, 1, 0).index_select(1, self._key_body_ids)
        states = (sim.root_states, sim.dof_pos, sim.dof_vel, key_body_pos.permute(2, 1, 0))
        if env_ids is None:
            return states
        root_states, dof_pos, dof_vel, key_body_pos = states
        return (
            root_states.index_select(0, env_ids),
            dof_pos.index_select(0, env_ids),
            dof_vel.index_select(0, env_ids),
            key_body_pos.index_select(0, env_ids),
        )

    @torch.inference_mode()
    def compute_reset(self) -> None:
        """Write `reset_buf` and the falls; a diverged simulation ends its episode as a fall."""
        self.reset_buf[:], self._terminate_buf[:] = compute_humanoid_reset(
            self.reset_buf,
            self.progress_buf,
            self.simulation.contact_forces,
            self._contact_body_ids,
            self.simulation.body_pos,
            self.max_episode_length,
            self.env_cfg.enable_early_termination,
            self._termination_heights_m,
        )
        failed = self.simulation.failed
        self.reset_buf.masked_fill_(failed, 1)
        self._terminate_buf.masked_fill_(failed, 1)
        self.report_diverged()

    def report_diverged(self) -> None:
        """Tell it in the infos, too."""
        self.extras["diverged_simulations"] = self.simulation.num_failures
        super().report_diverged()

    def failures(self) -> Tensor:
        """Return (N,) bool: the last step ended the episode by a fall."""
        return self._terminate_buf != 0

    # --- reset -----------------------------------------------------------------------------

    def reset(self) -> dict[str, Tensor]:
        """Start a new episode in every environment and return its first observations."""
        self.reset_idx(torch.arange(self.num_envs, device=self.device))
        return self._observations()

    def reset_idx(self, env_ids: Tensor) -> None:
        """Start new episodes in environments `env_ids` (n,)."""
        self.randomize(env_ids)
        self._reset_actors(env_ids)
        for counter in (self.progress_buf, self.reset_buf, self._terminate_buf):
            counter.index_fill_(0, env_ids, 0)
        self._observe_new_episodes(env_ids)

    def _observe_new_episodes(self, env_ids: Tensor) -> None:
        """Write the first observations of `env_ids` (n,)."""
        self.compute_observations(env_ids)

    def _reset_actors(self, env_ids: Tensor) -> None:
        """Put the humanoids into the default pose."""
        self._write_default_pose(env_ids)

    def _write_default_pose(self, env_ids: Tensor) -> None:
        """Upright, facing +x, at rest, all joint angles zero."""
        n = len(env_ids)
        root_states = torch.zeros(n, 13, device=self.device)
        root_states[:, 2] = _START_HEIGHT_M
        root_states[:, 6] = 1.0
        dofs = torch.zeros(n, self._layout.num_dofs, device=self.device)
        self.simulation.write_state(env_ids, root_states, dofs, dofs)
