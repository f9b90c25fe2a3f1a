"""VecTask: the life cycle of a batched task, with the contract of IsaacGymEnvs' base class.

A task fills in `create_sim`, `pre_physics_step`, `post_physics_step` and `reset_idx`; the base
owns the buffers, the spaces and the order of a step. What differs from IsaacGymEnvs:

- `time_outs` marks episodes that end at the time limit only: one that also *fails* in its last
  step is no time-out, so that trainers which bootstrap there do not value a fall.
- `step` returns copies, so that a caller may keep them over the next step.
- there is no process-wide simulation: tasks can be made side by side, and `close()` frees one.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import StepListener
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.rendering.tracks import TaskCamera
from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.base.action_scaling import ActionScaling
from isaacgymenvs_lite.tasks.randomization.randomizer import DomainRandomizer
from isaacgymenvs_lite.utils.threads import one_torch_thread, release_torch_threads

log = logging.getLogger(__name__)

_PICTURE_SIZE = (640, 480)


class Env(ABC):  # noqa: B024  a task is abstract through VecTask
    """Sizes, clip limits, devices and spaces, read from the configuration.

    Args:
        config: the task's configuration as plain dictionaries (cfg/task/<Task>.yaml composed);
            a task has written `numObservations`, `numActions` (and `numStates`) into its `env`.
        rl_device: torch device of the tensors that `step` and `reset` return.
        sim_device: `cpu` or `cuda:<index>`, where the physics runs.
        graphics_device_id: index of the rendering device, -1 for none.
        headless: without a window.

    Raises:
        ConfigError: a missing or impossible size.
    """

    def __init__(
        self,
        config: dict[str, Any],
        rl_device: str,
        sim_device: str,
        graphics_device_id: int,
        headless: bool,
    ) -> None:
        self.cfg = config
        env = config["env"]
        self.headless = headless
        self.rl_device = rl_device
        self.sim_device = sim_device
        self.device = tensor_device(sim_device, bool(config["sim"].get("use_gpu_pipeline", False)))
        self.graphics_device_id = (
            -1 if headless and not env.get("enableCameraSensors", False) else graphics_device_id
        )

        self.num_environments = self.num_envs = int(_required(env, "task.env.numEnvs"))
        if self.num_envs < 1:
            raise ConfigError(f"num_envs={self.num_envs}: expected at least one environment")
        self.num_agents = int(env.get("numAgents", 1))
        self.num_observations = self.num_obs = int(env.get("numObservations", 0))
        self.num_states = int(env.get("numStates", 0))
        self.num_actions = self.num_acts = int(_required(env, "task.env.numActions"))
        self.control_freq_inv = int(env.get("controlFrequencyInv", 1))
        self.clip_obs = float(env.get("clipObservations", np.inf))
        self.clip_actions = float(env.get("clipActions", np.inf))

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
        """Box of one environment's action, -1..1."""
        return self.act_space

    def get_task_obs_size(self) -> int:
        """Return how many of the last entries of an observation describe the task's goal."""
        return 0

    def observation_groups(self) -> dict[str, int]:
        """Return what an observation consists of: name -> how many numbers, in their order.

        Empty if the task does not say.
        """
        return {}

    def action_scaling(self) -> ActionScaling | None:
        """Return what an action means to the actuators; None if that depends on more than it."""
        return None

    def set_train_info(self, env_frames: int, *args: Any, **kwargs: Any) -> None:
        """Hear from the trainer how many environment steps were made so far."""
        del args, kwargs
        self.total_train_env_frames = env_frames

    def get_env_state(self) -> Any:
        """State that belongs into a checkpoint; None by default."""
        return None

    def set_env_state(self, env_state: Any) -> None:
        """Take back what `get_env_state` gave."""
        del env_state


class VecTask(Env):
    """N environments that step together. See the module docstring and `Env` for the arguments.

    Attributes:
        simulation: the backend; its state tensors are what tasks read.
        obs_buf: (N, numObs) float32.
        states_buf: (N, numStates) float32, privileged observations of asymmetric critics.
        rew_buf: (N,) float32.
        reset_buf: (N,) int64, 1 where an episode ended and none began since; starts at 1.
        progress_buf: (N,) int64, control steps of the running episode.
        timeout_buf: (N,) bool, ended by the time limit.
        extras: what `step` returns as infos; the same dictionary at every step.
        listeners: told of every step; see `StepListener`.
        max_episode_length: control steps; a task must set it.
        keeps_final_observations: whether a task that starts episodes in the step that ended the one
            before observes the end, too; see `final_observations`.
    """

    simulation: SimulationBackend
    max_episode_length: int
    progress_buf: Tensor
    actor_name: ClassVar[str] = "robot"
    """Name of the robot in `task.task.randomization_params.actor_params`."""
    resets_on_request: ClassVar[bool] = False
    """Whether episodes start when somebody calls `reset_done`, and not by themselves in `step`."""
    keeps_final_observations: bool = False
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"]}
    """What recorders of videos ask for."""

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
        up_axis = self.sim_params.get("up_axis", "z")
        if up_axis not in ("y", "z"):
            raise ConfigError(unknown("task.sim.up_axis", up_axis, ["y", "z"]))
        self.dt = float(_required(self.sim_params, "task.sim.dt"))
        self._failures_reported = 0
        self.listeners: list[StepListener] = []
        self._camera = TaskCamera(self, *_PICTURE_SIZE)
        self.create_sim()
        self.allocate_buffers()
        self.randomizer = self._make_randomizer(config.get("task") or {})

    def _make_randomizer(self, section: dict[str, Any]) -> DomainRandomizer | None:
        """Return what `task.task` asks for, None if it is off."""
        if not section.get("randomize", False):
            return None
        params = section.get("randomization_params") or {}
        layout = ModelLayout.from_model(self.simulation.model)
        return DomainRandomizer(params, self.simulation, layout, [self.actor_name])

    # --- what a task fills in -------------------------------------------------------------

    @abstractmethod
    def create_sim(self) -> None:
        """Set `self.simulation`; buffers do not exist yet."""

    @abstractmethod
    def pre_physics_step(self, actions: Tensor) -> None:
        """Turn clamped actions (N, numActions) into controls."""

    @abstractmethod
    def post_physics_step(self) -> None:
        """Count `progress_buf`, then compute observations, rewards and reset flags."""

    @abstractmethod
    def reset_idx(self, env_ids: Tensor) -> None:
        """Start new episodes in environments `env_ids` (n,)."""

    # --- life cycle -----------------------------------------------------------------------

    def allocate_buffers(self) -> None:
        """Create the buffers of the class docstring on the simulation's device."""
        n, device = self.num_envs, self.device
        self.obs_buf = torch.zeros(n, self.num_obs, device=device)
        self.states_buf = torch.zeros(n, self.num_states, device=device)
        self.rew_buf = torch.zeros(n, device=device)
        self.reset_buf = torch.ones(n, dtype=torch.int64, device=device)
        self.timeout_buf = torch.zeros(n, dtype=torch.bool, device=device)
        self.progress_buf = torch.zeros(n, dtype=torch.int64, device=device)
        self.randomize_buf = torch.zeros(n, dtype=torch.int64, device=device)
        self.extras: dict[str, Any] = {}
        self.obs_dict: dict[str, Tensor] = {}

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Any]]:
        """Advance all environments by one control step.

        Args:
            actions: (N, numActions), clamped to +-clipActions.

        Returns:
            observations {"obs": (N, numObs)[, "states": (N, numStates)]}, rewards (N,), dones
            (N,) int64 and infos, on rl_device. `infos["time_outs"]` is (N,) bool.
        """
        with one_torch_thread():
            actions = actions.to(self.device)
            if self.randomizer is not None:
                actions = self.randomizer.noisy_actions(actions)
            self.pre_physics_step(actions.clamp(-self.clip_actions, self.clip_actions))
            self.simulation.step()
            self.post_physics_step()
            self.control_steps += 1
            self.timeout_buf = self.compute_time_outs()
            if self.randomizer is not None:
                self.obs_buf.copy_(self.randomizer.noisy_observations(self.obs_buf))
            self.extras["time_outs"] = self.timeout_buf.to(self.rl_device)
            for watcher in self.listeners:
                watcher.after_step()
            return (
                self._observations(),
                self._for_trainer(self.rew_buf),
                self._for_trainer(self.dones()),
                self.extras,
            )

    def randomize(self, env_ids: Tensor) -> None:
        """Draw what is due where new episodes start, in environments `env_ids` (n,)."""
        if self.randomizer is not None:
            frame = self.control_steps * self.control_freq_inv
            self.randomizer.on_reset(env_ids, self.randomize_buf, frame)

    def dones(self) -> Tensor:
        """Return (N,) int64, 1 where the last step ended an episode."""
        return self.reset_buf

    def compute_time_outs(self) -> Tensor:
        """Return (N,) bool: the episode ended, by its length and not by a failure."""
        at_limit = self.progress_buf >= self.max_episode_length - 1
        return at_limit & (self.reset_buf != 0) & ~self.failures()

    def failures(self) -> Tensor:
        """Return (N,) bool: the last step ended the episode by a failure; none by default."""
        return torch.zeros_like(self.timeout_buf)

    def report_diverged(self) -> None:
        """Warn of diverged simulations: at the first one and at every power of ten."""
        total = self.simulation.num_failures
        if total > self._failures_reported and total >= 10 * self._failures_reported:
            log.warning("%d simulation(s) diverged so far and were reset; the run goes on", total)
            self._failures_reported = total

    def reset(self) -> dict[str, Tensor]:
        """Return the current observations, zero before the first step.

        As in IsaacGymEnvs nothing is reset here: `reset_buf` starts at 1, so that the first step
        does it. Tasks whose resets are asked for by the agent override this.
        """
        return self._observations()

    def reset_done(self) -> tuple[dict[str, Tensor], Tensor]:
        """Start new episodes where the last one ended.

        Returns:
            observations as `step`, and the ids of the environments that were reset (n,).
        """
        with one_torch_thread():
            done_ids = self.reset_buf.nonzero().flatten()
            if len(done_ids) > 0:
                self.reset_idx(done_ids)
            return self._observations(), done_ids.to(self.rl_device)

    def final_observations(self) -> dict[str, Tensor]:
        """Return what the episodes that the last step ended came to, between it and `reset_done`.

        Rows of other environments mean nothing. A task that starts episodes within the step has it
        only while `keeps_final_observations` is set.
        """
        return self._observations()

    def zero_actions(self) -> Tensor:
        """Return (N, numActions) zeros on rl_device."""
        return torch.zeros(self.num_envs, self.num_actions, device=self.rl_device)

    def get_state(self) -> Tensor:
        """Return the clamped privileged observations (N, numStates) on rl_device."""
        return self._clamped(self.states_buf)

    def render(self, mode: str = "rgb_array") -> Image | None:
        """Let whoever watches show the present state, and draw it.

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
        for watcher in self.listeners:
            watcher.render()
        if mode == "rgb_array" and (self.headless or self.virtual_screen_capture):
            return self._camera.draw((0,))[0]
        return None

    @property
    def is_watched(self) -> bool:
        """Whether a window or a page is open, for which a play goes on after its last episode."""
        return any(getattr(watcher, "keeps_playing", False) for watcher in self.listeners)

    def close(self) -> None:
        """Free the simulation and those who watch; the task cannot be stepped afterwards."""
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


def _required(section: dict[str, Any], path: str) -> Any:
    key = path.rpartition(".")[2]
    if key not in section:
        raise ConfigError(f"the key '{path}' is missing; expected a number")
    return section[key]


def _unbounded_box(size: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def tensor_device(sim_device: str, use_gpu_pipeline: bool) -> torch.device:
    """Return where a task's tensors live: with the physics, on the CPU by all backends so far.

    `sim_device=cuda:N` and `pipeline=gpu` of published commands are accepted; a line in the log
    says that the physics runs on the CPU.
    """
    if sim_device != "cpu" or use_gpu_pipeline:
        log.info(
            "physics runs on the CPU (mujoco.batch): sim_device=%s%s has no effect; observations"
            " go to rl_device",
            sim_device,
            " pipeline=gpu" if use_gpu_pipeline else "",
        )
    return torch.device("cpu")
