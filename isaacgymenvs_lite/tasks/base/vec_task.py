"""VecTask: N environments that step together, with the contract of IsaacGymEnvs.

**A step** has this order:

1. `step` replaces non-finite actions by zero, adds action noise, and clamps the actions.
2. `pre_physics_step` sets the controls that `compute_controls` returns.
3. `simulation.step` advances the physics.
4. `post_physics_step` starts new episodes and calls `update_state`, `compute_observations`,
   `compute_reward` and `compute_reset`.
5. `step` collects `infos`, adds observation noise, and calls the `listeners`.

A task implements the methods in the section "what a task fills in". `MjcfTask` adds checked
settings and an MJCF model.

**Episodes.** `step` returns the last observation of an episode and marks the end in `reset_buf`.
As in IsaacGymEnvs, the following step starts the next episode after its physics. The action of that
step has no effect, and the step returns the first observation of the episode. A call of
`reset_done` starts the next episode earlier. Three kinds of tasks differ:

- A task with `starts_before_physics` starts the next episode before the physics of a step.
- AnymalTerrain starts the next episode in the step that ends the previous one.
- A task of IsaacGymEnvs overrides `create_sim`, `pre_physics_step`, `post_physics_step` and
  `reset_idx`. Such a task starts episodes where it calls `reset_idx`, and its `reset` starts none.

**Tensors.** The first dimension is always N. The backend owns the state tensors of `simulation` and
changes them in `step` and `write_state`. The task owns the buffers that `VecTask` lists. These
buffers are on `device`. Each step replaces `actions` and `reward_terms`, and writes the other
buffers in place. Other code may write 1 into `reset_buf` between two steps. The tensors that `step`
and `reset_done` return are on `rl_device` and belong to the caller. Every step returns the same
`infos` dictionary with new tensors. A step waits for the device four times: to find non-finite
actions, discarded steps, entries of `reset_buf` without a cause, and the episodes that start.

**Differences from IsaacGymEnvs:**

- `time_outs` marks episodes that end at the time limit or whose simulation diverged. An episode
  that fails in its last step is not a time-out, because no trainer may bootstrap from a fall.
- A step whose simulation diverged has the reward 0, repeats the observation of the previous step,
  and ends its episode without a failure. `infos["diverged"]` marks such a step, and agents leave it
  out of their updates.
- A non-finite action is a failure with reward 0, and the physics receives zeros instead.
- Several tasks can exist in a process, and `close()` frees one of them.
"""

from __future__ import annotations

import logging
from typing import Any, ClassVar, Final, NamedTuple

import gymnasium
import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import StepListener
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.rendering.tracks import TaskCamera
from isaacgymenvs_lite.schema import read_keys
from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.base.reward_terms import Terms, total
from isaacgymenvs_lite.tasks.base.task_config import EnvConfig, StepConfig
from isaacgymenvs_lite.tasks.randomization.randomizer import DomainRandomizer
from isaacgymenvs_lite.utils.state import Stateful
from isaacgymenvs_lite.utils.threads import one_torch_thread, release_torch_threads

log = logging.getLogger(__name__)

_PICTURE_SIZE = (640, 480)


class Done:
    """Codes of `VecTask.done_buf`: how a step left an episode.

    The codes are plain integers, because torch is several times slower with an `IntEnum`.
    """

    RUNNING: Final = 0
    TIME_OUT: Final = 1
    """The episode reached its time limit and did not fail."""
    FAILED: Final = 2
    DIVERGED: Final = 3
    """The episode ended because the simulation diverged, which is not the policy's fault."""
    REACHED: Final = 4
    """The episode ended because the task's goal was reached."""


class ActionScaling(NamedTuple):
    """The mapping `offset + scale * action` to actuator targets, with `offset` and `scale` (A,).

    The `unit` is `rad` for position drives, and `Nm` or `N` (newton) for motors.
    """

    unit: str
    offset: Tensor
    scale: Tensor


class RobotState(NamedTuple):
    """State of a robot: root (13,), joint positions (D,) in rad and velocities (D,) in rad/s."""

    root_state: Tensor
    dof_pos: Tensor
    dof_vel: Tensor


class RobotDescription(NamedTuple):
    """Data that an exported policy needs in addition to the model and `ActionScaling`."""

    default: RobotState  # the default pose at rest
    start: RobotState  # state at the start of an episode
    key_bodies: tuple[str, ...]  # bodies in the observation part `key_body_pos`
    frames: dict[str, str]
    """Frame of each observation part: `world`, `base`, `joint` or `heading`. The heading frame is
    the world frame rotated about z by the heading of the base."""


class Env(Stateful):
    """Sizes, clip limits, devices and spaces of a task, from its configuration.

    `config` is cfg/task/<Task>.yaml as plain dictionaries. Its section `env` also holds
    `numObservations`, `numActions` and, for an asymmetric critic, `numStates`. `step` and `reset`
    return tensors on `rl_device`. The physics runs on the CPU for any `sim_device`.
    `graphics_device_id` is -1 if there is no rendering device.

    Raises:
        ConfigError: a size is missing or impossible.
    """

    num_observations: int
    num_actions: int

    def __init__(
        self,
        config: dict[str, Any],
        rl_device: str,
        sim_device: str,
        graphics_device_id: int,
        headless: bool,
    ) -> None:
        self.cfg = config
        env = read_keys(EnvConfig, config["env"], "task.env")
        sim = read_keys(StepConfig, config["sim"], "task.sim")
        self.headless = headless
        self.rl_device = rl_device
        self.sim_device = sim_device
        # Published commands with `sim_device=cuda:N` and `pipeline=gpu` are accepted.
        self.device = torch.device("cpu")
        if sim_device != "cpu" or sim.use_gpu_pipeline:
            log.info(
                "physics runs on the CPU (mujoco.batch): sim_device=%s%s has no effect;"
                " observations go to rl_device",
                sim_device,
                " pipeline=gpu" if sim.use_gpu_pipeline else "",
            )
        has_cameras = bool(config["env"].get("enableCameraSensors", False))
        self.graphics_device_id = -1 if headless and not has_cameras else graphics_device_id

        self.num_environments = self.num_envs = env.num_envs
        self.num_agents = env.num_agents
        self.num_observations = self.num_obs = env.num_observations
        self.num_states = env.num_states
        self.num_actions = self.num_acts = env.num_actions
        self.control_freq_inv = env.control_freq_inv
        self.clip_obs = env.clip_observations
        self.clip_actions = env.clip_actions
        self.sim_dt_s = sim.dt

        self.obs_space = _unbounded_box(self.num_obs)
        self.state_space = _unbounded_box(self.num_states)
        self.act_space = gymnasium.spaces.Box(-1.0, 1.0, (self.num_actions,), np.float32)

        self.total_train_env_frames = 0
        self.control_steps = 0

    @property
    def observation_space(self) -> gymnasium.Space:
        """Box of the observation of one environment."""
        return self.obs_space

    @property
    def action_space(self) -> gymnasium.Space:
        """Box of one action: [-1, 1], unless a train file of Isaac Lab sets other limits."""
        return self.act_space

    def get_task_obs_size(self) -> int:
        """Return how many of the last entries of an observation describe the task's goal."""
        return 0

    def observation_groups(self) -> dict[str, int]:
        """Return the ordered names and sizes of the observation parts, or {} if undefined."""
        return {}

    def action_scaling(self) -> ActionScaling | None:
        """Return the mapping from actions to actuator targets, or None if it is not constant."""
        return None

    def robot_description(self) -> RobotDescription | None:
        """Return the data that an exported policy needs, or None if the task has no robot."""
        return None

    def set_train_info(self, env_frames: int, *args: Any, **kwargs: Any) -> None:
        """Store the number of environment steps that the trainer has made."""
        self.total_train_env_frames = env_frames

    def get_env_state(self) -> Any:
        """Return the state that a checkpoint stores. The base method returns None."""
        return None

    def set_env_state(self, env_state: Any) -> None:
        """Restore a state that `get_env_state` returned."""


class VecTask(Env):
    """N environments that step together; the module docstring describes a step.

    `Env` describes the arguments, except the last two, which come from IsaacGymEnvs.

    Attributes:
        simulation: the backend, whose state tensors the task reads.
        obs_buf: (N, numObs) float32.
        states_buf: (N, numStates) float32, privileged observations of an asymmetric critic.
        rew_buf: (N,) float32.
        reward_terms: terms (N,) by name, whose sum is `rew_buf`.
        reset_buf: (N,) int64, 1 where an episode ended and the next episode has not started. All
            entries are 1 at first.
        done_buf: (N,) int64, codes of `Done` that say how the last step left each episode.
            `reset_done` clears the entries of the episodes that it starts.
        timeout_buf: (N,) bool, `infos["time_outs"]` of the last step.
        diverged_buf: (N,) bool, True where the simulation diverged in the last step.
        progress_buf: (N,) int64, control steps of the running episode.
        actions: (N, numActions), the clamped actions of the last step.
        extras: the infos that `step` returns, the same dictionary at every step.
        listeners: objects that every step calls (see `StepListener`).
        max_episode_length: time limit of an episode in control steps, which a task must set.
        sim_dt_s: time of one simulator call, `task.sim.dt` (s).
        control_dt_s: nominal time of a control step (s).
        dt: the attribute of this name in IsaacGymEnvs (s). In AnymalTerrain and in the AMP and ASE
            humanoids it equals `control_dt_s`, in other tasks `sim_dt_s`. This project's tasks do
            not read `dt`.
        is_training: whether an agent is learning from the task. During training, a task may end
            episodes early.
        keeps_final_observations: whether AnymalTerrain computes `final_observations`.
    """

    simulation: SimulationBackend
    max_episode_length: int
    progress_buf: Tensor
    actor_name: ClassVar[str] = "robot"
    """Name of the robot in `task.task.randomization_params.actor_params`."""
    other_actors: ClassVar[dict[str, str]] = {}
    """Maps the names of objects and furniture in `actor_params` to their first bodies."""
    starts_before_physics: ClassVar[bool] = False
    """Whether a step starts episodes before its physics (see the module docstring)."""
    zero_action_at_reset: ClassVar[bool] = False
    """Whether the step that starts an episode ignores its action, because the action was chosen for
    the last state of the previous episode. True needs `starts_before_physics`."""
    agents_call_reset_done: ClassVar[bool] = False
    """Whether agents call `reset_done` before each step, so that the first action of an episode
    belongs to its first observation. `reset_idx` then computes this observation. `RLGPUEnv` calls
    `reset_done` for agents that do not."""
    is_training: bool = False
    keeps_final_observations: bool = False
    not_stored: ClassVar[tuple[str, ...]] = (
        *("cfg", "sim_params", "listeners", "_camera", "headless", "graphics_device_id"),
        *("force_render", "virtual_screen_capture"),
    )
    """Names of attributes that checkpoints omit (see `Stateful`)."""
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"]}

    def __init__(
        self,
        config: dict[str, Any],
        rl_device: str,
        sim_device: str,
        graphics_device_id: int,
        headless: bool,
        virtual_screen_capture: bool = False,
        force_render: bool = False,
    ) -> None:
        super().__init__(config, rl_device, sim_device, graphics_device_id, headless)
        self.virtual_screen_capture = virtual_screen_capture
        self.force_render = force_render
        self.sim_params = config["sim"]
        self.physics_engine = config.get("physics_engine", "physx")
        self.dt = self.sim_dt_s
        self._failures_reported = 0
        self._warned_of_actions = False
        self.listeners: list[StepListener] = []
        self._camera = TaskCamera(self, *_PICTURE_SIZE)
        self.create_sim()
        self.allocate_buffers()
        self.randomizer: DomainRandomizer | None = None
        section = config.get("task") or {}
        if section.get("randomize", False):
            params = section.get("randomization_params") or {}
            layout = ModelLayout.from_model(self.simulation.model)
            actors = {self.actor_name: "", **self.other_actors}
            self.randomizer = DomainRandomizer(params, self.simulation, layout, actors)

    # --- what a task fills in -------------------------------------------------------------

    def create_sim(self) -> None:
        """Set `self.simulation`, before the buffers exist."""
        raise self._undefined("create_sim")

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the actuators' controls (N, U) for clamped actions (N, A)."""
        raise self._undefined("compute_controls")

    def update_state(self) -> None:
        """Update the task's own state after the physics of a control step."""

    def compute_obs(self) -> Tensor:
        """Return the observations (N, numObs) of the current state, without noise."""
        raise self._undefined("compute_obs")

    def compute_obs_of(self, env_ids: Tensor) -> Tensor:
        """Return the observations (n, numObs) of environments (n,) that start an episode."""
        return self.compute_obs().index_select(0, env_ids)

    def compute_states(self, env_ids: Tensor | None, observations: Tensor) -> Tensor:
        """Return the privileged observations (n, numStates) of an asymmetric critic.

        `env_ids` (n,) selects environments, and None selects all. `observations` (n, numObs) have
        no noise. The base method returns them unchanged.
        """
        return observations

    def add_sensor_noise(self, observations: Tensor) -> Tensor:
        """Return observations (n, numObs) with sensor noise. The base method adds none."""
        return observations

    def compute_reward_terms(self) -> Terms:
        """Return the reward terms (N,) by name."""
        raise self._undefined("compute_reward_terms")

    def compute_failures(self) -> Tensor:
        """Return where (N,) an episode ends by a failure. The base method returns False."""
        return torch.zeros_like(self.timeout_buf)

    def compute_reached(self) -> Tensor | None:
        """Return where (N,) an episode ends because its goal is reached. None means nowhere."""
        return None

    def episode_successes(self) -> dict[str, Tensor]:
        """Return by name how far the running episodes (N,) succeeded.

        A value is 0 or 1, or a number of successes. Logs and evaluations contain the means over
        episodes of the values at their ends.
        """
        return {}

    def compute_time_outs(self) -> Tensor:
        """Return where (N,) an episode reached its time limit, whether it failed or not."""
        return self.progress_buf >= self.max_episode_length - 1

    def reset_state(self, env_ids: Tensor) -> None:
        """Put environments `env_ids` (n,) into the state of a new episode."""
        raise self._undefined("reset_state")

    def on_key(self, key: str) -> None:
        """React to a key press in a viewer, between two steps. The base method does nothing.

        A held key counts once. A viewer sends at most 20 keys a second.

        Args:
            key: `up`, `down`, `left`, `right`, `space`, a lower-case letter, or a digit. The
                viewer's window keeps `v` and `r` for itself.
        """

    @property
    def key_help(self) -> str:
        """Help text about the keys of `on_key`, empty if the task has no keys."""
        return ""

    def infos(self) -> dict[str, Any]:
        """Return additional infos of a step. The base method returns none."""
        return {}

    @property
    def control_dt_s(self) -> float:
        """Nominal time of a control step (s)."""
        return self.control_freq_inv * self.sim_dt_s

    def _undefined(self, method: str) -> NotImplementedError:
        return NotImplementedError(
            f"{type(self).__name__} has no {method}(); docs/own_task.md shows what a task defines"
        )

    def allocate_buffers(self) -> None:
        """Create the buffers of the class docstring on the simulation's device."""
        n, device = self.num_envs, self.device
        self.obs_buf = torch.zeros(n, self.num_obs, device=device)
        self.states_buf = torch.zeros(n, self.num_states, device=device)
        self.rew_buf = torch.zeros(n, device=device)
        self.reset_buf = torch.ones(n, dtype=torch.int64, device=device)
        self.done_buf = torch.zeros(n, dtype=torch.int64, device=device)
        self.timeout_buf = torch.zeros(n, dtype=torch.bool, device=device)
        self.diverged_buf = torch.zeros_like(self.timeout_buf)
        self._bad_actions = torch.zeros_like(self.timeout_buf)
        # Marks environments (N,) whose last step has no valid outcome. None stands for no
        # environment.
        self._discarded: Tensor | None = None
        self.progress_buf = torch.zeros(n, dtype=torch.int64, device=device)
        self.randomize_buf = torch.zeros(n, dtype=torch.int64, device=device)
        self.actions = torch.zeros(n, self.num_actions, device=device)
        self.reward_terms: Terms = {}
        self.extras: dict[str, Any] = {}
        self.obs_dict: dict[str, Tensor] = {}
        self._observed_before: dict[str, Tensor] = {}

    # --- a step -----------------------------------------------------------------------------

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Any]]:
        """Advance all environments by one control step.

        Args:
            actions: (N, numActions), clamped to +-clipActions.

        Returns:
            Observations {"obs": (N, numObs)[, "states": (N, numStates)]}, rewards (N,), dones
            (N,) int64, and infos, all on rl_device. `infos["time_outs"]` and `infos["diverged"]`
            are (N,) bool.
        """
        with one_torch_thread():
            self._observed_before = dict(self.obs_dict)
            actions = self._finite_actions(actions.to(self.device))
            if self.randomizer is not None:
                actions = self.randomizer.noisy_actions(actions)
            self.pre_physics_step(actions.clamp(-self.clip_actions, self.clip_actions))
            self.simulation.step()
            self.done_buf.zero_()
            self.diverged_buf.copy_(self.simulation.failed)
            discarded = self.diverged_buf | self._bad_actions
            self._discarded = discarded if bool(discarded.any()) else None
            self.post_physics_step()
            self.control_steps += 1
            if self._discarded is not None:
                self._end_discarded(self._discarded)
            is_unexplained = self.reset_buf > self.done_buf
            if bool(is_unexplained.any()):  # tasks of IsaacGymEnvs write only `reset_buf`
                timed_out = self.compute_time_outs() & ~self.compute_failures()
                codes = timed_out.long().masked_fill_(~timed_out, Done.FAILED)
                self.done_buf.copy_(torch.where(is_unexplained, codes, self.done_buf))
            torch.eq(self.done_buf, Done.TIME_OUT, out=self.timeout_buf)
            if self._discarded is not None:
                self.timeout_buf |= self.diverged_buf
            self.extras.update(self.infos())
            if successes := self.episode_successes():
                self.extras["successes"] = {n: self._for_trainer(s) for n, s in successes.items()}
                self.extras["terminate"] = self._for_trainer(self.done_buf == Done.FAILED)
            self.extras["time_outs"] = self._for_trainer(self.timeout_buf)
            self.extras["diverged"] = self._for_trainer(self.diverged_buf)
            if self.randomizer is not None:
                self.obs_buf.copy_(self.randomizer.noisy_observations(self.obs_buf))
            if self._discarded is not None:
                self._repeat_observations({"obs": self.obs_buf, "states": self.states_buf})
            for listener in self.listeners:
                listener.after_step()
            dones = self.done_buf.sign().to(self.rl_device, non_blocking=True)
            return self._observations(), self._for_trainer(self.rew_buf), dones, self.extras

    def pre_physics_step(self, actions: Tensor) -> None:
        """Set the controls for clamped actions (N, numActions)."""
        self.actions = actions
        if self.starts_before_physics:
            if self.zero_action_at_reset:
                self.actions = actions.masked_fill((self.reset_buf != 0)[:, None], 0.0)
            self._start_episodes()
        self.simulation.set_controls(self.compute_controls(self.actions))

    def post_physics_step(self) -> None:
        """Count the step, then compute observations, rewards and ends of episodes."""
        self.extras.clear()
        self.progress_buf += 1
        self.randomize_buf += 1
        if not self.starts_before_physics:
            self._start_episodes()
        self.update_state()
        self.compute_observations()
        self.compute_reward()
        self.compute_reset()

    def compute_observations(self, env_ids: Tensor | None = None) -> None:
        """Write all observations, or first observations of `env_ids` (n,), into `obs_buf`."""
        if env_ids is None:
            observations = self.compute_obs()
            if self.num_states > 0:
                self.states_buf.copy_(self.compute_states(None, observations))
            self.obs_buf.copy_(self.add_sensor_noise(observations))
        else:
            observations = self.compute_obs_of(env_ids)
            if self.num_states > 0:
                states = self.compute_states(env_ids, observations)
                self.states_buf.index_copy_(0, env_ids, states)
            self.obs_buf.index_copy_(0, env_ids, self.add_sensor_noise(observations))

    def compute_reward(self) -> None:
        """Write the rewards of all environments into `rew_buf`."""
        terms = self.compute_reward_terms()
        if (discarded := self._discarded) is not None:
            terms = {name: term.masked_fill(discarded, 0.0) for name, term in terms.items()}
        self.reward_terms = terms
        reward = next(iter(terms.values())) if len(terms) == 1 else total(terms)
        self.rew_buf.copy_(reward)

    def compute_reset(self) -> None:
        """Write into the buffers which episodes end and why."""
        self.done_buf.copy_(self.compute_time_outs())
        self.done_buf.masked_fill_(self.compute_failures(), Done.FAILED)
        if (reached := self.compute_reached()) is not None:
            self.done_buf.masked_fill_(reached, Done.REACHED)
        if self._discarded is not None:
            self._write_discarded_codes()
        torch.sign(self.done_buf, out=self.reset_buf)

    # --- discarded steps: non-finite actions and diverged simulations -----------------------

    def _finite_actions(self, actions: Tensor) -> Tensor:
        """Replace non-finite rows of actions (N, A) by zeros, and mark them in `_bad_actions`."""
        self._bad_actions.zero_()
        # A finite sum is a cheap proof that all actions are finite. A sum may overflow, so the rows
        # decide.
        if bool(actions.sum().isfinite()):
            return actions
        torch.logical_not(actions.isfinite().all(dim=-1), out=self._bad_actions)
        if not self._warned_of_actions and bool(self._bad_actions.any()):
            self._warned_of_actions = True
            log.warning(
                "the action of environment %d is not finite, so its episode ends as a failure with"
                " reward 0; check the policy (reported once)",
                int(self._bad_actions.nonzero()[0]),
            )
        return actions.masked_fill(self._bad_actions.unsqueeze(-1), 0.0)

    def _end_discarded(self, discarded: Tensor) -> None:
        """End the episodes of discarded steps (N,) with reward 0, and log diverged simulations."""
        self.rew_buf.masked_fill_(discarded, 0.0)
        self.reset_buf.masked_fill_(discarded & (self.done_buf == Done.RUNNING), 1)
        self._write_discarded_codes()
        count = self.simulation.num_failures
        if count > self._failures_reported and count >= 10 * self._failures_reported:
            log.warning("%d simulation(s) diverged so far and were reset; the run goes on", count)
            self._failures_reported = count

    def _write_discarded_codes(self) -> None:
        self.done_buf.masked_fill_(self._bad_actions, Done.FAILED)
        self.done_buf.masked_fill_(self.diverged_buf, Done.DIVERGED)

    def _repeat_observations(self, observations: dict[str, Tensor]) -> None:
        """Replace observations of diverged simulations by observations of the previous step."""
        cut_off = self.diverged_buf & (self.reset_buf != 0)
        for name, before in self._observed_before.items():
            rows = observations[name]
            env_ids = cut_off.nonzero().flatten().to(rows.device)
            rows.index_copy_(0, env_ids, before.to(rows.device).index_select(0, env_ids))

    # --- resets -----------------------------------------------------------------------------

    def reset(self) -> dict[str, Tensor]:
        """Start a new episode in every environment and return the first observations.

        A task of IsaacGymEnvs starts no episode here, and returns its current observations, which
        are zero at first.
        """
        if self._resets_itself:
            return self._observations()
        self.reset_buf.fill_(1)
        return self.reset_done()[0]

    def reset_done(self) -> tuple[dict[str, Tensor], Tensor]:
        """Start episodes where `reset_buf` is 1, and return all observations and the ids (n,)."""
        with one_torch_thread():
            env_ids = self._start_episodes()
            self.done_buf.index_fill_(0, env_ids, Done.RUNNING)
            is_observed = self.agents_call_reset_done or self._resets_itself
            if len(env_ids) > 0 and not is_observed:
                self.compute_observations(env_ids)
            return self._observations(), env_ids.to(self.rl_device)

    @property
    def _resets_itself(self) -> bool:
        """Whether the task defines `reset_idx` instead of `reset_state`, as in IsaacGymEnvs."""
        return type(self).reset_state is VecTask.reset_state

    def _start_episodes(self) -> Tensor:
        """Start episodes where `reset_buf` is 1, and return the ids (n,) of their environments."""
        env_ids = self.reset_buf.nonzero().flatten()
        if len(env_ids) > 0:
            self.reset_idx(env_ids)
        return env_ids

    def reset_idx(self, env_ids: Tensor) -> None:
        """Start new episodes in environments `env_ids` (n,)."""
        if self.randomizer is not None:
            frame = self.control_steps * self.control_freq_inv
            self.randomizer.on_reset(env_ids, self.randomize_buf, frame)
        self.reset_state(env_ids)
        self.progress_buf.index_fill_(0, env_ids, 0)
        self.reset_buf.index_fill_(0, env_ids, 0)
        if self.agents_call_reset_done:
            self.compute_observations(env_ids)

    def final_observations(self) -> dict[str, Tensor]:
        """Return the last observations of the episodes that the last step ended.

        Call this method before `reset_done`. Only the rows of ended episodes are valid.
        AnymalTerrain needs `keeps_final_observations`.
        """
        return self._observations()

    # --- for trainers and viewers -----------------------------------------------------------

    def zero_actions(self) -> Tensor:
        """Return zeros (N, numActions) on rl_device."""
        return torch.zeros(self.num_envs, self.num_actions, device=self.rl_device)

    def get_state(self) -> Tensor:
        """Return the clamped privileged observations (N, numStates) on rl_device."""
        return self._clamped(self.states_buf)

    def render(self, mode: str = "rgb_array") -> Image | None:
        """Render the current state in all viewers, and return a picture of it.

        Args:
            mode: `rgb_array` returns a picture (480, 640, 3) of environment 0, which needs no
                display. A task with a window must be made with `virtual_screen_capture`. `human`
                returns None.

        Raises:
            ConfigError: the mode is unknown.
            RenderingError: this machine cannot draw.
        """
        modes = self.metadata["render_modes"]
        if mode not in modes:
            raise ConfigError(unknown("mode of render", mode, modes))
        for listener in self.listeners:
            listener.render()
        if mode == "rgb_array" and (self.headless or self.virtual_screen_capture):
            return self._camera.draw((0,))[0]
        return None

    @property
    def is_watched(self) -> bool:
        """Whether an open viewer keeps playing after the last episode."""
        return any(getattr(listener, "keeps_playing", False) for listener in self.listeners)

    def close(self) -> None:
        """Close the listeners and free the simulation. The task cannot be stepped any more."""
        while self.listeners:
            self.listeners.pop().close()
        self._camera.close()
        self.simulation.close()
        release_torch_threads(self)

    def _observations(self) -> dict[str, Tensor]:
        self.obs_dict["obs"] = self._clamped(self.obs_buf)
        if self.num_states > 0:
            self.obs_dict["states"] = self.get_state()
        return dict(self.obs_dict)

    def _clamped(self, buffer: Tensor) -> Tensor:
        return buffer.clamp(-self.clip_obs, self.clip_obs).to(self.rl_device, non_blocking=True)

    def _for_trainer(self, buffer: Tensor) -> Tensor:
        return buffer.clone().to(self.rl_device, non_blocking=True)


def _unbounded_box(size: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
