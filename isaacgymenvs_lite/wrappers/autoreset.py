"""AutoresetTask: one reset convention for all tasks, which the adapters to other libraries use.

Tasks start the next episode at different times (see `VecTask`). Here all of them start it within
the step that ended the one before. A step returns the last observation of an episode and the
first of the next, and separates failures from time limits.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import diverged_in, reports_divergence
from isaacgymenvs_lite.errors import ConfigError, WrapperError, unknown
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.rendering.tracks import TaskCamera
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.random_stream import RandomStream

Observations = dict[str, Tensor]
"""{"obs": (N, F)[, "states": (N, S)]}; states are for asymmetric critics."""
RENDER_MODE = "rgb_array"


@dataclass(frozen=True)
class EndedEpisodes:
    """The n episodes that ended with a step.

    Attributes:
        env_ids: (n,) int64, their environments.
        returns: (n,) float64 sums of rewards.
        lengths: (n,) int64 control steps.
        time_s: since the task was wrapped.
    """

    env_ids: Tensor
    returns: Tensor
    lengths: Tensor
    time_s: float


@dataclass(frozen=True)
class Transition:
    """The results of a step of N environments; their tensors are not written to later.

    Attributes:
        observations: of the running episodes, the first ones where an episode ended.
        final_observations: of the step's end, before episodes started; only the rows of ended
            episodes count. None if none ended.
        rewards: (N,) float32.
        terminated: (N,) bool, ended by a failure.
        truncated: (N,) bool, ended by the time limit and nothing else, or cut off because the
            simulation diverged; the final observation is then the last good one.
        per_env: infos with a row for each environment, (N, ...), at the step's end: `amp_obs` of
            an ended episode is its last. `diverged` (N,) bool only where a simulation did.
        scalars: infos about all of them, by name: `episode/rew_torque`.
        episodes: those that ended.
    """

    observations: Observations
    final_observations: Observations | None
    rewards: Tensor
    terminated: Tensor
    truncated: Tensor
    per_env: dict[str, Tensor]
    scalars: dict[str, float]
    episodes: EndedEpisodes

    @property
    def ended(self) -> Tensor:
        """(N,) bool, ended at all."""
        return self.terminated | self.truncated


class AutoresetTask:
    """Steps and draws a task; see the module docstring.

    Args:
        task: what `isaacgymenvs_lite.make` returns.
        adapter: name of the adapter, for errors.
        random: random numbers of the task.
        render_mode: `rgb_array`, or None for no pictures.
        width: pixels of a picture.
        height: pixels.

    Attributes:
        last_step: the results of the last step; None before the first.
        num_steps: control steps made so far.

    Raises:
        WrapperError: `task` is something else, for example a wrapped task.
        ConfigError: another render mode.
    """

    def __init__(
        self,
        task: Any,
        adapter: str,
        random: RandomStream | None = None,
        render_mode: str | None = None,
        width: int = 320,
        height: int = 240,
    ) -> None:
        self.task = checked_task(task, adapter)
        if render_mode not in (None, RENDER_MODE):
            raise ConfigError(unknown("render_mode", render_mode, [RENDER_MODE, "None"]))
        self.task.keeps_final_observations = True
        self.render_mode = render_mode
        self.last_step: Transition | None = None
        self.num_steps = 0
        self._camera = TaskCamera(self.task, width, height)
        self._random = random or RandomStream()
        num_envs, device = self.task.num_envs, self.task.rl_device
        # In float64: a thousand float32 rewards would lose digits.
        self._returns = torch.zeros(num_envs, dtype=torch.float64, device=device)
        self._lengths = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._start_s = time.perf_counter()

    @property
    def num_envs(self) -> int:
        """N."""
        return self.task.num_envs

    @property
    def render_fps(self) -> int:
        """Pictures per second that show the task in real time, a whole number."""
        return max(1, round(1.0 / self.task.simulation.dt))

    def reset(self, seed: int | None = None) -> Observations:
        """Start new episodes; a seed determines all later random numbers of the task."""
        if seed is not None:
            self._random.seed(seed)
        self._returns.zero_()
        self._lengths.zero_()
        with self._stepping():
            return self.task.reset()

    def reset_some(self, mask: Tensor, seed: int | None = None) -> Observations:
        """Start new episodes where `mask` (N,) bool is True; return the observations of all."""
        if seed is not None:
            self._random.seed(seed)
        self._restart_counts(mask.to(self.task.rl_device))
        with self._stepping():
            self.task.reset_buf.masked_fill_(mask.to(self.task.device), 1)
            return self.task.reset_done()[0]

    def step(self, actions: Tensor) -> Transition:
        """Make one control step with actions (N, A), and start the next episodes."""
        expected = (self.num_envs, self.task.num_actions)
        if tuple(actions.shape) != expected:
            raise ConfigError(f"actions of shape {tuple(actions.shape)}: expected {expected}")
        with self._stepping():
            observations, rewards, dones, infos = self.task.step(actions.to(torch.float32))
            ended = dones != 0
            final = None
            if ended.any():
                final = self.task.final_observations()
                observations = self.task.reset_done()[0]
            truncated = infos["time_outs"] & ended
            per_env, scalars = _sorted_infos(infos, self.num_envs)
            self.last_step = Transition(
                observations=observations,
                final_observations=final,
                rewards=rewards,
                terminated=ended & ~truncated,
                truncated=truncated,
                per_env=per_env,
                scalars=scalars,
                episodes=self._count(rewards, ended),
            )
            self.num_steps += 1
            return self.last_step

    def draw(self) -> list[Image]:
        """Return a picture (height, width, 3) of each environment."""
        return self._camera.draw(range(self.num_envs))

    def render(self) -> list[Image] | None:
        """Return what `draw` returns; None without a render mode."""
        return self.draw() if self.render_mode else None

    def close(self) -> None:
        """Free renderer and simulation; a second call does nothing."""
        self._camera.close()
        self.task.close()

    def _restart_counts(self, mask: Tensor) -> None:
        self._returns.masked_fill_(mask, 0.0)
        self._lengths.masked_fill_(mask, 0)

    def _count(self, rewards: Tensor, ended: Tensor) -> EndedEpisodes:
        self._returns += rewards
        self._lengths += 1
        env_ids = ended.nonzero().flatten()
        time_s = time.perf_counter() - self._start_s
        episodes = EndedEpisodes(env_ids, self._returns[env_ids], self._lengths[env_ids], time_s)
        self._restart_counts(ended)
        return episodes

    @contextmanager
    def _stepping(self) -> Iterator[None]:
        """Use the environment's random numbers; make tensors that may be written to later.

        rsl_rl steps in inference mode, outside of which such tensors could not be changed.
        """
        with self._random, torch.inference_mode(False), torch.no_grad():
            yield


def checked_task(env: Any, adapter: str) -> VecTask:
    """Return `env` if it is a task without a wrapper, else raise a `WrapperError`."""
    if isinstance(env, VecTask):
        return env
    raise WrapperError(
        f"{adapter}: got {type(env).__name__}, expected a task as isaacgymenvs_lite.make(task=...)"
        " returns it; wrap the task itself, and put the library's own wrappers around the adapter"
    )


def _sorted_infos(
    infos: Mapping[str, Any], num_envs: int
) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Split infos into those with a row for each environment and scalars.

    Without `time_outs`, and without `diverged` where it says nothing.
    """
    per_env: dict[str, Tensor] = {}
    scalars: dict[str, float] = {}
    for name, value in infos.items():
        says_nothing = (
            name == "diverged" and reports_divergence(value) and diverged_in(infos, "cpu") is None
        )
        if name == "time_outs" or says_nothing:
            continue
        if isinstance(value, Mapping):
            scalars |= {f"{name}/{key}": float(entry) for key, entry in value.items()}
        elif isinstance(value, Tensor) and value.dim() > 0 and len(value) == num_envs:
            per_env[name] = value
        elif isinstance(value, (int, float)) or (isinstance(value, Tensor) and value.dim() == 0):
            scalars[name] = float(value)
    return per_env, scalars
