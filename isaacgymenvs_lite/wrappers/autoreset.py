"""Gives all tasks one reset convention, which the wrappers for other libraries use.

Tasks start the next episode at different times (see `VecTask`). In `AutoresetTask` the step that
ends an episode also starts the next episode. This step returns the last observation of the ended
episode and the first observation of the next episode, and distinguishes failures from time limits.
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
"""{"obs": (N, F)}, or {"obs": (N, F), "states": (N, S)} for asymmetric critics."""
RENDER_MODE = "rgb_array"


@dataclass(frozen=True)
class EndedEpisodes:
    """The n episodes that ended in one step.

    Attributes:
        env_ids: (n,) int64, indices of the environments.
        returns: (n,) float64, sums of the rewards.
        lengths: (n,) int64, numbers of control steps.
        time_s: time since the task was wrapped.
    """

    env_ids: Tensor
    returns: Tensor
    lengths: Tensor
    time_s: float


@dataclass(frozen=True)
class Transition:
    """The results of a step of N environments; later steps do not change these tensors.

    Attributes:
        observations: observations of the running episodes. After the end of an episode the row is
            the first observation of the next episode.
        final_observations: observations before the next episodes started, or None if no episode
            ended. Only the rows of ended episodes have a meaning.
        rewards: (N,) float32.
        terminated: (N,) bool, whether a failure ended the episode.
        truncated: (N,) bool, whether the time limit ended the episode without a failure, or the
            simulation diverged. After a divergence the final observation is the last observation
            before the divergence.
        per_env: infos with a row for each environment, (N, ...), before the next episodes started.
            `diverged` (N,) bool exists only if a simulation diverged.
        scalars: dictionary of infos about all environments, for example `episode/rew_torque`.
        episodes: the episodes that ended.
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
        """(N,) bool, whether the episode ended for any reason."""
        return self.terminated | self.truncated


class AutoresetTask:
    """Steps and draws a task; see the module docstring.

    Args:
        task: a task of `isaacgymenvs_lite.make`.
        adapter: name of the wrapper, which errors contain.
        random: random stream of the task.
        render_mode: `rgb_array`, or None to draw no pictures.
        width: width of a picture in pixels.
        height: height of a picture in pixels.

    Attributes:
        last_step: the results of the last step, or None before the first step.
        num_steps: number of control steps so far.

    Raises:
        WrapperError: `task` is a wrapped task or another object.
        ConfigError: the render mode is unknown.
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
        # The sums are float64, because float32 sums of a thousand rewards lose digits.
        self._returns = torch.zeros(num_envs, dtype=torch.float64, device=device)
        self._lengths = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._start_s = time.perf_counter()

    @property
    def num_envs(self) -> int:
        """Number of environments N."""
        return self.task.num_envs

    @property
    def render_fps(self) -> int:
        """The frame rate (an integer) at which a video plays in real time."""
        return max(1, round(1.0 / self.task.simulation.dt))

    def reset(self, seed: int | None = None) -> Observations:
        """Start new episodes; `seed` determines all later random values of the task."""
        if seed is not None:
            self._random.seed(seed)
        self._returns.zero_()
        self._lengths.zero_()
        with self._stepping():
            return self.task.reset()

    def reset_some(self, mask: Tensor, seed: int | None = None) -> Observations:
        """Start episodes where `mask` (N,) is True; return the observations of all environments."""
        if seed is not None:
            self._random.seed(seed)
        self._restart_counts(mask.to(self.task.rl_device))
        with self._stepping():
            self.task.reset_buf.masked_fill_(mask.to(self.task.device), 1)
            return self.task.reset_done()[0]

    def step(self, actions: Tensor) -> Transition:
        """Make one control step with actions (N, A); start a new episode where one ended."""
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
        """Return the result of `draw`, or None without a render mode."""
        return self.draw() if self.render_mode else None

    def close(self) -> None:
        """Release the renderer and the simulation; a second call does nothing."""
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
        """Use the environment's random stream, and leave inference mode.

        rsl_rl steps in inference mode; tensors made in inference mode cannot be changed later.
        """
        with self._random, torch.inference_mode(False), torch.no_grad():
            yield


def checked_task(env: Any, adapter: str) -> VecTask:
    """Return `env` if it is a task without a wrapper.

    Raises:
        WrapperError: `env` is a wrapped task or another object.
    """
    if isinstance(env, VecTask):
        return env
    raise WrapperError(
        f"{adapter}: got {type(env).__name__}, expected a task as isaacgymenvs_lite.make(task=...)"
        " returns it; wrap the task itself, and put the library's own wrappers around the adapter"
    )


def _sorted_infos(
    infos: Mapping[str, Any], num_envs: int
) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Split infos into infos with a row for each environment and scalars.

    `time_outs` is left out. `diverged` is left out unless a simulation diverged.
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
