"""ClassicTask: what the classic tasks of IsaacGymEnvs have in common, from keys to resets.

A task says what its keys are, which model it simulates, how actions become controls, what is
observed and what is paid; the order in which that happens stands here once.

Where an episode ends the step returns its last observation, as in IsaacGymEnvs. The next step
starts a new episode: before the physics (`resets_before_physics`), or after it, so that the action
of that step has no effect and what is returned is the first state of the new episode. Trainers that
want a new episode in the same step call `reset_done` after each step; a task may do so by itself
(`resets_in_same_step`): the step that ends an episode returns the first observation of the next.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.simulation.backend import make_simulation
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.base.assets import asset_path, compile_model
from isaacgymenvs_lite.tasks.base.reward_terms import Terms, total
from isaacgymenvs_lite.tasks.base.task_config import (
    UNREAD_ENV_KEYS,
    AssetConfig,
    PlaneConfig,
    SimConfig,
    read_sim_config,
)
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.threads import one_torch_thread


@dataclass(frozen=True, kw_only=True)
class ClassicConfig:
    """Keys of `task.env` that every classic task reads."""

    clip_actions: float = setting(1.0, key="clipActions", above=0)
    """Actions are clamped to this magnitude."""
    control_freq_inv: int = setting(1, key="controlFrequencyInv", minimum=1)
    """Simulator calls of `sim.dt` in a control step."""
    asymmetric_observations: bool = setting(False)
    """This project's for these tasks: the critic is given the observation without noise, as
    `states`; for train files with a `central_value_config`."""
    asset: AssetConfig = field(default_factory=AssetConfig)
    plane: PlaneConfig = field(default_factory=PlaneConfig)


class ClassicTask(VecTask):
    """A task that starts its episodes by itself within `step`; see the module docstring.

    Attributes:
        settings_class: dataclass of the keys of `task.env`.
        own_asset: the task's MJCF, relative to assets/.
        published_assets: names that published task files give to their model.
        actor_name: name of the robot in `task.task.randomization_params.actor_params`.
        num_features: numbers in an observation.
        num_controls: numbers in an action.
        resets_before_physics: where in a step episodes start.
        resets_in_same_step: episodes start in the step that ended the one before, after its reward
            and before its observation.
        actions: (N, A) of the last step, clamped.
        reward_terms: (N,) each, whose sum is `rew_buf`.

    Raises:
        ConfigError: a key or value of `task.env` or `task.sim` that cannot be used.
    """

    settings_class: ClassVar[type[ClassicConfig]] = ClassicConfig
    own_asset: ClassVar[str]
    published_assets: ClassVar[tuple[str, ...]] = ()
    actor_name: ClassVar[str]
    num_features: ClassVar[int]
    num_controls: ClassVar[int]
    resets_before_physics: ClassVar[bool] = False
    resets_in_same_step: ClassVar[bool] = False

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
        env = cfg["env"]
        self.sim_cfg: SimConfig = read_sim_config(cfg["sim"])
        self.env_cfg: Any = read_section(
            self.settings_class, env, "task.env", ignored=UNREAD_ENV_KEYS
        )
        env["numObservations"], env["numActions"] = self.num_features, self.num_controls
        env["numStates"] = self.num_features if self.env_cfg.asymmetric_observations else 0
        env.setdefault("clipActions", self.env_cfg.clip_actions)
        self.max_episode_length = self._episode_length()
        self._model = self._build_model()
        self._layout = ModelLayout.from_model(self._model)
        super().__init__(
            cfg,
            rl_device,
            sim_device,
            graphics_device_id,
            headless,
            virtual_screen_capture,
            force_render,
        )

    # --- what a task fills in ---------------------------------------------------------------

    @abstractmethod
    def _episode_length(self) -> int:
        """Return the control steps of an episode."""

    @abstractmethod
    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the actuators' controls (N, U) for clamped actions (N, A)."""

    @abstractmethod
    def observe(self) -> Tensor:
        """Return the observations (N, num_features), without noise, of the state of now."""

    @abstractmethod
    def compute_reward_terms(self) -> Terms:
        """Return the terms (N,) of the reward, by name."""

    @abstractmethod
    def compute_failures(self) -> Tensor:
        """Return (N,) bool: the episode ends by a failure."""

    @abstractmethod
    def reset_state(self, env_ids: Tensor) -> None:
        """Put environments `env_ids` (n,) into the state of a new episode."""

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Change the task's MJCF before it is compiled; nothing by default."""
        del spec

    def advance(self) -> None:
        """Update what the task remembers from step to step, after physics and resets."""

    def measured(self, observations: Tensor) -> Tensor:
        """Return what the policy hears of observations (n, num_features): by default the same."""
        return observations

    def simulator_calls(self) -> int:
        """Return the simulator calls of `sim.dt` in a control step."""
        return self.env_cfg.control_freq_inv

    def infos(self) -> dict[str, Any]:
        """Return what `step` tells beside `time_outs`; nothing by default."""
        return {}

    # --- construction -----------------------------------------------------------------------

    def _build_model(self) -> mujoco.MjModel:
        path = asset_path(self.env_cfg.asset, self.own_asset, self.published_assets)
        friction = self.env_cfg.plane.dynamic_friction
        return compile_model(path, self.sim_cfg, friction, self.change_spec)

    def create_sim(self) -> None:
        """Make the N simulations of the model."""
        physx = self.cfg["sim"].get("physx") or {}
        self.simulation = make_simulation(
            self._model,
            self.num_envs,
            substeps=self.sim_cfg.substeps * self.simulator_calls(),
            num_threads=int(physx.get("num_threads", 0)),
        )

    def allocate_buffers(self) -> None:
        """Add the actions of the last step, and how episodes ended in it."""
        super().allocate_buffers()
        self.actions = torch.zeros(self.num_envs, self.num_actions, device=self.device)
        self._done_buf = torch.zeros_like(self.reset_buf)
        self._failure_buf = torch.zeros_like(self.timeout_buf)
        self._time_out_buf = torch.zeros_like(self.timeout_buf)
        self.reward_terms: Terms = {}
        self._final_observations: dict[str, Tensor] = {}

    # --- step -------------------------------------------------------------------------------

    def pre_physics_step(self, actions: Tensor) -> None:
        """Set the controls of clamped actions (N, A)."""
        if self.resets_in_same_step:
            # Nothing to do but in a first step that no `reset` went before.
            self._reset_finished()
        self.actions = actions
        if self.resets_before_physics:
            self._reset_finished()
        self.simulation.set_controls(self.compute_controls(actions))

    def post_physics_step(self) -> None:
        """Count the step; start episodes; observe; reward; end episodes."""
        self.progress_buf += 1
        self.randomize_buf += 1
        if self.resets_in_same_step:
            self.advance()
            self.compute_reset()
            self.compute_reward()
            if self.keeps_final_observations and self.reset_buf.any():
                self.compute_observations()
                self._final_observations = self._observations()
            self._reset_finished()
            self.compute_observations()
        else:
            if not self.resets_before_physics:
                self._reset_finished()
            self.advance()
            self.compute_observations()
            self.compute_reward()
            self.compute_reset()
        # What was told of the last step is not true of this one.
        self.extras.clear()
        self.extras.update(self.infos())

    def compute_observations(self) -> None:
        """Write the observations of all environments into `obs_buf`."""
        observations = self.observe()
        if self.num_states > 0:
            self.states_buf.copy_(observations)
        self.obs_buf.copy_(self.measured(observations))

    def compute_reward(self) -> None:
        """Write the rewards of all environments into `rew_buf`."""
        self.reward_terms = self.compute_reward_terms()
        self.rew_buf.copy_(total(self.reward_terms))

    def compute_reset(self) -> None:
        """Write which episodes ended; a diverged simulation ends its own by a failure."""
        torch.logical_or(self.compute_failures(), self.simulation.failed, out=self._failure_buf)
        at_limit = self.progress_buf >= self.max_episode_length - 1
        self.reset_buf.copy_(self._failure_buf | at_limit)
        # Kept apart, as episodes that start in this step clear `reset_buf` and `progress_buf`.
        self._done_buf.copy_(self.reset_buf)
        torch.logical_and(at_limit, ~self._failure_buf, out=self._time_out_buf)
        self.report_diverged()

    def dones(self) -> Tensor:
        """Return (N,) int64, 1 where the last step ended an episode."""
        return self._done_buf

    def compute_time_outs(self) -> Tensor:
        """Return (N,) bool: the episode ended, by its length and not by a failure."""
        return self._time_out_buf.clone()

    def failures(self) -> Tensor:
        """Return (N,) bool: the last step ended the episode by a failure."""
        return self._failure_buf

    def final_observations(self) -> dict[str, Tensor]:
        """See `VecTask.final_observations`."""
        return (
            self._final_observations if self.resets_in_same_step else super().final_observations()
        )

    # --- reset ------------------------------------------------------------------------------

    def _reset_finished(self) -> None:
        env_ids = self.reset_buf.nonzero().flatten()
        if len(env_ids) > 0:
            self.reset_idx(env_ids)

    def reset_idx(self, env_ids: Tensor) -> None:
        """Start new episodes in environments `env_ids` (n,)."""
        self.randomize(env_ids)
        self.reset_state(env_ids)
        self.progress_buf.index_fill_(0, env_ids, 0)
        self.reset_buf.index_fill_(0, env_ids, 0)

    def reset(self) -> dict[str, Tensor]:
        """Start a new episode in every environment and return its first observations."""
        self.reset_buf.fill_(1)
        return self.reset_done()[0]

    def reset_done(self) -> tuple[dict[str, Tensor], Tensor]:
        """Start new episodes where the last one ended, and observe them; see `VecTask`."""
        with one_torch_thread():
            env_ids = self.reset_buf.nonzero().flatten()
            if len(env_ids) > 0:
                self.reset_idx(env_ids)
                observations = self.observe().index_select(0, env_ids)
                if self.num_states > 0:
                    self.states_buf.index_copy_(0, env_ids, observations)
                self.obs_buf.index_copy_(0, env_ids, self.measured(observations))
            return self._observations(), env_ids.to(self.rl_device)
