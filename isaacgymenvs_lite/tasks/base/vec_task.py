"""VecTask: the life of N environments that step together, with the contract of IsaacGymEnvs.

`VecTask` has the order of a control step and of a reset, once for all tasks. A task fills in what
is its own: `compute_controls`, `compute_obs`, `compute_reward_terms`, `compute_failures`,
`reset_state` and, if it needs them, the other methods of the same section. `MjcfTask` adds what
most tasks share before the first step: checked keys and a model. A task of IsaacGymEnvs overrides
`create_sim`, `pre_physics_step`, `post_physics_step` and `reset_idx` instead (`ResetMode.CUSTOM`).

What differs from IsaacGymEnvs:

- `time_outs` marks episodes that end at the time limit or whose simulation diverged: one that also
  *fails* in its last step is no time-out, so that trainers which bootstrap there do not value a
  fall.
- A step whose simulation diverged earns nothing and cuts its episode off: not a failure, as the
  task did not end it. Its last observation is the last good one, of the step before, and
  `infos["diverged"]` marks it, so that agents leave it out of their updates.
- An action that is not finite is a failure without a reward; the physics gets zero in its place.
- `step` returns copies, so that a caller may keep them over the next step.
- There is no process-wide simulation: tasks can be made side by side, and `close()` frees one.
"""

from __future__ import annotations

import enum
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


class ResetMode(enum.Enum):
    """When a task starts the next episode of an environment whose episode ended."""

    BEFORE_PHYSICS = enum.auto()
    """In the next step, before the physics. `step` returns the last observation of an episode."""
    AFTER_PHYSICS = enum.auto()
    """In the next step, after the physics: its action has no effect, and it returns the first
    observation. The step before returned the last one, as in IsaacGymEnvs."""
    SAME_STEP = enum.auto()
    """In the step that ended the episode, after its reward and before its observation."""
    ON_REQUEST = enum.auto()
    """When the agent calls `reset_done`. `step` returns the last observation of an episode."""
    CUSTOM = enum.auto()
    """In `pre_physics_step` or `post_physics_step` of the task, which overrides them and writes
    `reset_buf`, as in IsaacGymEnvs."""


class Done:
    """How a step left an episode: the codes of `VecTask.done_buf`.

    Plain numbers: an operation of torch with an `IntEnum` takes several times as long.
    """

    RUNNING: Final = 0
    TIME_OUT: Final = 1
    """It reached its time limit and did not fail."""
    FAILED: Final = 2
    DIVERGED: Final = 3
    """Its simulation diverged: the episode was cut off, which says nothing about the policy."""


class ActionScaling(NamedTuple):
    """What an action means to the actuators: their targets are `offset + scale * action`.

    Attributes:
        unit: of the targets: `rad` of position drives, `Nm` or `N` of motors.
        offset: (A,).
        scale: (A,).
    """

    unit: str
    offset: Tensor
    scale: Tensor


class RobotState(NamedTuple):
    """A state of one robot, as `SimulationBackend.write_state` takes it.

    Attributes:
        root_state: (13,).
        dof_pos: (D,) rad.
        dof_vel: (D,) rad/s.
    """

    root_state: Tensor
    dof_pos: Tensor
    dof_vel: Tensor


class RobotDescription(NamedTuple):
    """What a program needs to drive the robot of a task, beside the model and `ActionScaling`.

    Attributes:
        default: the default pose, at rest.
        start: a state in which an episode of the training can start.
        key_bodies: whose positions the observation part `key_body_pos` holds, in order.
        frames: frame of each observation part: `world`; `heading`, world axes turned about z so
            that the base faces +x; `base`; `joint`.
    """

    default: RobotState
    start: RobotState
    key_bodies: tuple[str, ...]
    frames: dict[str, str]


class Env(Stateful):
    """Sizes, clip limits, devices and spaces of a task, from its configuration.

    Args:
        config: the task's configuration as plain dictionaries (cfg/task/<Task>.yaml composed). The
            task has written `numObservations`, `numActions` (and `numStates`) into its `env`.
        rl_device: torch device of the tensors that `step` and `reset` return.
        sim_device: `cpu` or `cuda:<index>`, where the physics runs.
        graphics_device_id: index of the rendering device, -1 for none.
        headless: without a window.

    Attributes:
        num_envs: N.
        num_observations: numbers in an observation; a task that derives from `MjcfTask` declares
            it in its class.
        num_actions: numbers in an action; likewise.
        num_states: numbers in the observation of an asymmetric critic, 0 for none.

    Raises:
        ConfigError: a missing or impossible size.
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
        self.device = tensor_device(sim_device, sim.use_gpu_pipeline)
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
        """Box of one environment's observation."""
        return self.obs_space

    @property
    def action_space(self) -> gymnasium.Space:
        """Box of one environment's action; -1..1 except with a train file of Isaac Lab."""
        return self.act_space

    def get_task_obs_size(self) -> int:
        """Return how many of the last entries of an observation describe the task's goal."""
        return 0

    def observation_groups(self) -> dict[str, int]:
        """Return the parts of an observation in their order: name -> how many numbers.

        Empty if the task does not define it.
        """
        return {}

    def action_scaling(self) -> ActionScaling | None:
        """Return what an action means to the actuators; None if that depends on the state."""
        return None

    def robot_description(self) -> RobotDescription | None:
        """Return what it takes to drive the robot elsewhere; None if the task has no robot."""
        return None

    def set_train_info(self, env_frames: int, *args: Any, **kwargs: Any) -> None:
        """Store how many environment steps the trainer has made so far."""
        self.total_train_env_frames = env_frames

    def get_env_state(self) -> Any:
        """Return the state that a checkpoint stores; None by default."""
        return None

    def set_env_state(self, env_state: Any) -> None:
        """Restore what `get_env_state` returned."""


class VecTask(Env):
    """N environments that step together. See the module docstring and `Env` for the arguments.

    Attributes:
        simulation: the backend; its state tensors are what tasks read.
        obs_buf: (N, numObs) float32.
        states_buf: (N, numStates) float32, privileged observations of asymmetric critics.
        rew_buf: (N,) float32.
        reward_terms: (N,) each, whose sum is `rew_buf`.
        reset_buf: (N,) int64, 1 where an episode ended and the next one did not start yet, at
            first everywhere. A 1 that is written makes the next reset start an episode.
        done_buf: (N,) int64, how the last step left each episode, see `Done`. A reset within the
            step leaves it as it is, `reset_done` of an `ON_REQUEST` task clears it.
        timeout_buf: (N,) bool, the last step ended the episode by its time limit, or cut it off
            because the simulation diverged.
        diverged_buf: (N,) bool, the simulation diverged in the last step.
        progress_buf: (N,) int64, control steps of the running episode.
        actions: (N, numActions) of the last step, clamped.
        extras: what `step` returns as infos; the same dictionary at every step.
        listeners: called at every step; see `StepListener`.
        max_episode_length: control steps; a task must set it.
        sim_dt_s: time of one simulator call, `task.sim.dt` (s).
        control_dt_s: time that a control step counts (s).
        dt: as IsaacGymEnvs' task of this name defines it (s): `sim_dt_s`, but `control_dt_s` in
            AnymalTerrain and the AMP and ASE humanoids. The tasks themselves read one of the other
            two; the time that a step simulates is `simulation.dt`.
        is_training: whether an agent learns from the task, which this project's agents set: then a
            task may end episodes for the sake of learning. A loop of your own may set it.
        keeps_final_observations: whether a `SAME_STEP` task also observes the ends of episodes; see
            `final_observations`.
    """

    simulation: SimulationBackend
    max_episode_length: int
    progress_buf: Tensor
    actor_name: ClassVar[str] = "robot"
    """Name of the robot in `task.task.randomization_params.actor_params`."""
    reset_mode: ResetMode = ResetMode.CUSTOM
    zero_action_at_reset: ClassVar[bool] = False
    """`BEFORE_PHYSICS`: an action counts as zero in the step that starts an episode, because it was
    chosen for the last state of the one before. After `reset` or `reset_done` actions count."""
    is_training: bool = False
    keeps_final_observations: bool = False
    not_stored: ClassVar[tuple[str, ...]] = (
        *("cfg", "sim_params", "listeners", "_camera", "headless", "graphics_device_id"),
        *("force_render", "virtual_screen_capture"),
    )
    """Attributes that a resumed training makes again; see `Stateful`, which stores the others."""
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"]}
    """What video recorders read."""

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
        self.randomizer = self._make_randomizer(config.get("task") or {})

    def _make_randomizer(self, section: dict[str, Any]) -> DomainRandomizer | None:
        """Return the randomiser of `task.task`, None if it is off."""
        if not section.get("randomize", False):
            return None
        params = section.get("randomization_params") or {}
        layout = ModelLayout.from_model(self.simulation.model)
        return DomainRandomizer(params, self.simulation, layout, [self.actor_name])

    # --- what a task fills in -------------------------------------------------------------

    def create_sim(self) -> None:
        """Set `self.simulation`; buffers do not exist yet."""
        raise self._undefined("create_sim")

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the actuators' controls (N, U) for clamped actions (N, A)."""
        raise self._undefined("compute_controls")

    def update_state(self) -> None:
        """Update what the task remembers from step to step, after the physics."""

    def compute_obs(self) -> Tensor:
        """Return the observations (N, numObs) of the current state, without noise."""
        raise self._undefined("compute_obs")

    def compute_obs_of(self, env_ids: Tensor) -> Tensor:
        """Return the observations (n, numObs) of environments (n,) that start an episode."""
        return self.compute_obs().index_select(0, env_ids)

    def compute_states(self, env_ids: Tensor | None, observations: Tensor) -> Tensor:
        """Return what an asymmetric critic observes (n, numStates), in tasks that have one.

        Args:
            env_ids: (n,) of these environments; None: of all.
            observations: (n, numObs) of them, without noise; the result by default.
        """
        return observations

    def add_sensor_noise(self, observations: Tensor) -> Tensor:
        """Return what the policy observes of observations (n, numObs): by default the same."""
        return observations

    def compute_reward_terms(self) -> Terms:
        """Return the terms (N,) of the reward, by name."""
        raise self._undefined("compute_reward_terms")

    def compute_failures(self) -> Tensor:
        """Return (N,) bool: the episode ends by a failure; none by default."""
        return torch.zeros_like(self.timeout_buf)

    def compute_time_outs(self) -> Tensor:
        """Return (N,) bool: the episode is at its time limit, whether it fails or not."""
        return self.progress_buf >= self.max_episode_length - 1

    def reset_state(self, env_ids: Tensor) -> None:
        """Put environments `env_ids` (n,) into the state of a new episode."""
        raise self._undefined("reset_state")

    def on_key(self, key: str) -> None:
        """React to a key that was pressed in a viewer, between two steps; nothing by default.

        A key that is held counts once. At most 20 keys a second arrive.

        Args:
            key: `up`, `down`, `left`, `right`, `space`, or a lower-case letter or digit; the
                window keeps `v` and `r` for itself.
        """

    @property
    def key_help(self) -> str:
        """What the keys of `on_key` do, for users; '': nothing."""
        return ""

    def infos(self) -> dict[str, Any]:
        """Return further infos of a step, besides `time_outs`; none by default."""
        return {}

    @property
    def control_dt_s(self) -> float:
        """Time that a control step counts in s."""
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
        # (N,) bool where the last step has no outcome; None: everywhere it has one.
        self._discarded: Tensor | None = None
        self.progress_buf = torch.zeros(n, dtype=torch.int64, device=device)
        self.randomize_buf = torch.zeros(n, dtype=torch.int64, device=device)
        self.actions = torch.zeros(n, self.num_actions, device=device)
        self.reward_terms: Terms = {}
        self.extras: dict[str, Any] = {}
        self.obs_dict: dict[str, Tensor] = {}
        self._observed_before: dict[str, Tensor] = {}
        self._final_observations: dict[str, Tensor] = {}

    # --- a step -----------------------------------------------------------------------------

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Any]]:
        """Advance all environments by one control step.

        Args:
            actions: (N, numActions), clamped to +-clipActions.

        Returns:
            observations {"obs": (N, numObs)[, "states": (N, numStates)]}, rewards (N,), dones
            (N,) int64 and infos, on rl_device. `infos["time_outs"]` and `infos["diverged"]` are
            (N,) bool.
        """
        with one_torch_thread():
            self._observed_before = dict(self.obs_dict)
            actions = self._finite_actions(actions.to(self.device))
            if self.randomizer is not None:
                actions = self.randomizer.noisy_actions(actions)
            self.done_buf.zero_()
            self.pre_physics_step(actions.clamp(-self.clip_actions, self.clip_actions))
            self.simulation.step()
            self._find_discarded()
            self.post_physics_step()
            self.control_steps += 1
            if self._discarded is not None:
                self._end_discarded(self._discarded)
            dones = self._dones()
            self.timeout_buf = self.done_buf == Done.TIME_OUT
            if self._discarded is not None:
                self.timeout_buf |= self.done_buf == Done.DIVERGED
            self.extras.update(self.infos())
            self.extras["time_outs"] = self.timeout_buf.to(self.rl_device)
            self.extras["diverged"] = self.diverged_buf.to(self.rl_device)
            if self.randomizer is not None:
                self.obs_buf.copy_(self.randomizer.noisy_observations(self.obs_buf))
            if self._discarded is not None and self.reset_mode is not ResetMode.SAME_STEP:
                self._repeat_observations({"obs": self.obs_buf, "states": self.states_buf})
            for listener in self.listeners:
                listener.after_step()
            return (
                self._observations(),
                self._for_trainer(self.rew_buf),
                dones.to(self.rl_device, non_blocking=True),
                self.extras,
            )

    def pre_physics_step(self, actions: Tensor) -> None:
        """Set the controls of clamped actions (N, numActions)."""
        if self.reset_mode is ResetMode.SAME_STEP:
            self._reset_ended()  # in a first step without a `reset` before it
        self.actions = actions
        if self.reset_mode is ResetMode.BEFORE_PHYSICS:
            if self.zero_action_at_reset:
                self.actions = actions.masked_fill((self.reset_buf != 0)[:, None], 0.0)
            self._reset_ended()
        self.simulation.set_controls(self.compute_controls(self.actions))

    def post_physics_step(self) -> None:
        """Count the step; observe, reward, end episodes and start the next ones."""
        self.extras.clear()
        self.progress_buf += 1
        self.randomize_buf += 1
        if self.reset_mode is ResetMode.SAME_STEP:
            self.update_state()
            self.compute_reset()
            self.compute_reward()
            if self.keeps_final_observations and self.reset_buf.any():
                self.compute_observations()
                self._final_observations = self._observations()
                if self._discarded is not None:
                    self._repeat_observations(self._final_observations)
            self._reset_ended()
            self.compute_observations()
        else:
            if self.reset_mode is ResetMode.AFTER_PHYSICS:
                self._reset_ended()
            self.update_state()
            self.compute_observations()
            self.compute_reward()
            self.compute_reset()

    def compute_observations(self, env_ids: Tensor | None = None) -> None:
        """Write the observations of all environments, or of `env_ids` (n,), into `obs_buf`."""
        observations = self.compute_obs() if env_ids is None else self.compute_obs_of(env_ids)
        if self.num_states > 0:
            _write_rows(self.states_buf, env_ids, self.compute_states(env_ids, observations))
        _write_rows(self.obs_buf, env_ids, self.add_sensor_noise(observations))

    def compute_reward(self) -> None:
        """Write the rewards of all environments into `rew_buf`."""
        self.reward_terms = self.compute_reward_terms()
        if (discarded := self._discarded) is not None:
            terms = self.reward_terms.items()
            self.reward_terms = {name: term.masked_fill(discarded, 0.0) for name, term in terms}
        self.rew_buf.copy_(total(self.reward_terms))

    def compute_reset(self) -> None:
        """Write which episodes end, and how."""
        self.done_buf.copy_(self.compute_time_outs())
        self.done_buf.masked_fill_(self.compute_failures(), Done.FAILED)
        if self._discarded is not None:
            self._write_discarded_codes()
        torch.sign(self.done_buf, out=self.reset_buf)

    def _dones(self) -> Tensor:
        """Return (N,) int64, 1 where the step ended an episode; complete `done_buf`.

        A task may have written `reset_buf` alone, as those of IsaacGymEnvs do.
        """
        dones = self.done_buf.sign()
        if self.reset_mode is ResetMode.SAME_STEP or torch.equal(dones, self.reset_buf):
            return dones
        timed_out = self.compute_time_outs() & ~self.compute_failures()
        codes = timed_out.long().masked_fill_(~timed_out, Done.FAILED)
        ended = self.reset_buf != 0
        self.done_buf.copy_(torch.where(dones != 0, self.done_buf, codes) * ended)
        return ended.long()

    # --- steps without an outcome -----------------------------------------------------------

    def _finite_actions(self, actions: Tensor) -> Tensor:
        """Return actions (N, A) with zeros in rows that are not finite; write `_bad_actions`."""
        self._bad_actions.zero_()
        # One sum is cheap; it may also overflow.
        if bool(actions.sum().isfinite()):
            return actions
        torch.logical_not(actions.isfinite().all(dim=-1), out=self._bad_actions)
        if not self._warned_of_actions and bool(self._bad_actions.any()):
            self._warned_of_actions = True
            log.warning(
                "an action of environment %d is not finite: its episode ends as a failure, without"
                " a reward; check the policy (this is reported once)",
                int(self._bad_actions.nonzero()[0]),
            )
        return actions.masked_fill(self._bad_actions.unsqueeze(-1), 0.0)

    def _find_discarded(self) -> None:
        """Write where the step has no outcome: the simulation diverged, or the action was bad."""
        self.diverged_buf = self.simulation.failed.clone()
        discarded = self.diverged_buf | self._bad_actions
        self._discarded = discarded if bool(discarded.any()) else None

    def _end_discarded(self, discarded: Tensor) -> None:
        """End the episodes of `discarded` (N,) without a reward, in tasks of all kinds."""
        self.rew_buf.masked_fill_(discarded, 0.0)
        self._write_discarded_codes()
        if self.reset_mode is not ResetMode.SAME_STEP:
            self.reset_buf.masked_fill_(discarded, 1)
        self._report_diverged()

    def _write_discarded_codes(self) -> None:
        self.done_buf.masked_fill_(self._bad_actions, Done.FAILED)
        self.done_buf.masked_fill_(self.diverged_buf, Done.DIVERGED)

    def _repeat_observations(self, observations: dict[str, Tensor]) -> None:
        """Write the observations before the step where it diverged, in place."""
        for name, before in self._observed_before.items():
            rows = observations[name]
            env_ids = self.diverged_buf.nonzero().flatten().to(rows.device)
            rows.index_copy_(0, env_ids, before.to(rows.device).index_select(0, env_ids))

    def _report_diverged(self) -> None:
        """Warn of diverged simulations: at the first one and at every power of ten."""
        count = self.simulation.num_failures
        if count > self._failures_reported and count >= 10 * self._failures_reported:
            log.warning("%d simulation(s) diverged so far and were reset; the run goes on", count)
            self._failures_reported = count

    # --- resets -----------------------------------------------------------------------------

    def reset(self) -> dict[str, Tensor]:
        """Start a new episode in every environment and return its first observations.

        A `CUSTOM` task resets nothing here, as in IsaacGymEnvs: it returns the current
        observations, zero at first, and its first step does the reset.
        """
        if self.reset_mode is ResetMode.CUSTOM:
            return self._observations()
        self.reset_buf.fill_(1)
        return self.reset_done()[0]

    def reset_done(self) -> tuple[dict[str, Tensor], Tensor]:
        """Start new episodes where `reset_buf` is 1, and observe them.

        Returns:
            observations as `step`, and the ids of the environments that were reset (n,).
        """
        with one_torch_thread():
            env_ids = self._reset_ended()
            observed_by_reset_idx = self.reset_mode in (ResetMode.ON_REQUEST, ResetMode.CUSTOM)
            if len(env_ids) > 0 and not observed_by_reset_idx:
                self.compute_observations(env_ids)
            return self._observations(), env_ids.to(self.rl_device)

    def reset_idx(self, env_ids: Tensor) -> None:
        """Start new episodes in environments `env_ids` (n,)."""
        self.randomize(env_ids)
        self.reset_state(env_ids)
        self.progress_buf.index_fill_(0, env_ids, 0)
        self.reset_buf.index_fill_(0, env_ids, 0)
        if self.reset_mode is ResetMode.ON_REQUEST:
            # Between two steps: this is what the policy acts on next.
            self.done_buf.index_fill_(0, env_ids, Done.RUNNING)
            self.compute_observations(env_ids)

    def _reset_ended(self) -> Tensor:
        """Start new episodes where `reset_buf` is 1; return these environments (n,)."""
        env_ids = self.reset_buf.nonzero().flatten()
        if len(env_ids) > 0:
            self.reset_idx(env_ids)
        return env_ids

    def randomize(self, env_ids: Tensor) -> None:
        """Draw the physical parameters that are due, in environments `env_ids` (n,)."""
        if self.randomizer is not None:
            frame = self.control_steps * self.control_freq_inv
            self.randomizer.on_reset(env_ids, self.randomize_buf, frame)

    def final_observations(self) -> dict[str, Tensor]:
        """Return the last observations of the episodes that the last step ended.

        To be called before `reset_done`. Rows of other environments have no meaning. A `SAME_STEP`
        task has them only while `keeps_final_observations` is set.
        """
        if self.reset_mode is ResetMode.SAME_STEP:
            return self._final_observations
        return self._observations()

    # --- for trainers and viewers -----------------------------------------------------------

    def zero_actions(self) -> Tensor:
        """Return (N, numActions) zeros on rl_device."""
        return torch.zeros(self.num_envs, self.num_actions, device=self.rl_device)

    def get_state(self) -> Tensor:
        """Return the clamped privileged observations (N, numStates) on rl_device."""
        return self._clamped(self.states_buf)

    def render(self, mode: str = "rgb_array") -> Image | None:
        """Render the current state in all viewers, and return a picture of it.

        Args:
            mode: `rgb_array` returns a picture (480, 640, 3) of environment 0, drawn without a
                display; with a window only if the task was made with `virtual_screen_capture`.
                `human` returns None.

        Raises:
            ConfigError: another mode.
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
        """Whether a window or a page is open, for which a play goes on after its last episode."""
        return any(getattr(listener, "keeps_playing", False) for listener in self.listeners)

    def close(self) -> None:
        """Close the listeners and free the simulation; the task cannot be stepped afterwards."""
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


def _write_rows(buffer: Tensor, env_ids: Tensor | None, rows: Tensor) -> None:
    """Write rows (n, F) of environments (n,) into a buffer (N, F), or all of them for None."""
    if env_ids is None:
        buffer.copy_(rows)
    else:
        buffer.index_copy_(0, env_ids, rows)


def _unbounded_box(size: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def tensor_device(sim_device: str, use_gpu_pipeline: bool) -> torch.device:
    """Return the device of a task's tensors: the physics' device, the CPU with all backends so far.

    `sim_device=cuda:N` and `pipeline=gpu` of published commands are accepted, with a line in the
    log.
    """
    if sim_device != "cpu" or use_gpu_pipeline:
        log.info(
            "physics runs on the CPU (mujoco.batch): sim_device=%s%s has no effect; observations"
            " go to rl_device",
            sim_device,
            " pipeline=gpu" if use_gpu_pipeline else "",
        )
    return torch.device("cpu")
