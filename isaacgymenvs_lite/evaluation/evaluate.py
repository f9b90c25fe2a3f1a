"""Runs episodes with a policy and measures them, for players, trainings and benchmarks."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.config.train_params import player_class_note
from isaacgymenvs_lite.env_interface import (
    Env,
    GoalEnv,
    ReferenceEnv,
    diverged_in,
    failures,
    fits,
)
from isaacgymenvs_lite.evaluation.body_tracks import tracks_of_clips
from isaacgymenvs_lite.evaluation.motion_coverage import MotionCoverage
from isaacgymenvs_lite.evaluation.pose_error import (
    EpisodeRecorder,
    ImitationResult,
    PoseErrorMetric,
    ReferencePoses,
)

log = logging.getLogger(__name__)

Policy = Callable[[dict[str, Tensor]], Tensor]
"""Maps observations to actions (N, A) for the task's `step`."""


@dataclass(frozen=True)
class EvaluationResult:
    """The measured values of a policy, as means over episodes."""

    num_episodes: int  # the same number in each environment
    reward: float  # sum of the task's rewards in an episode
    steps: float  # control steps of an episode
    style_reward: float | None  # reward of the discriminator per step, or None if there is none
    # Pose error and falls, or None for a task without reference motions.
    imitation: ImitationResult | None
    # Errors of the task's goal as means over all steps; empty if the task has no goal.
    goal_errors: dict[str, float] = field(default_factory=dict)
    # Means of `VecTask.episode_successes` at the ends of the episodes; empty if the task has none.
    successes: dict[str, float] = field(default_factory=dict)
    falls: float = 0.0  # share of the episodes that ended before the time limit, 0 to 1

    def __str__(self) -> str:
        """Return one line for users."""
        parts = [f"{self.num_episodes} episodes"]
        # A task without a reward function returns 1 at every step.
        if not math.isclose(self.reward, self.steps, rel_tol=1e-6):
            parts.append(f"reward {self.reward:.2f}")
        parts.append(f"episode length {self.steps:.1f} steps")
        if self.style_reward is not None:
            parts.append(f"style reward {self.style_reward:.3f} per step")
        parts += [f"{name} {mean:.3f}" for name, mean in self.goal_errors.items()]
        parts += [f"{n.replace('_', ' ')} {mean:.3f}" for n, mean in self.successes.items()]
        if self.imitation is None:
            parts.append(f"falls {self.falls:.0%}")
        else:
            parts.append(str(self.imitation))  # includes the share of falls
        return "; ".join(parts)


class _ImitationProbe:
    """Records body positions of a task with reference motions."""

    def __init__(self, env: ReferenceEnv, episodes_per_env: int) -> None:
        self._env, self._sim = env, env.simulation
        clips = tracks_of_clips(env.motion_lib, env.dt)
        self._metric = PoseErrorMetric(
            ReferencePoses.from_tracks(clips),
            MotionCoverage(clips, env.dt),
            env.max_episode_length,
        )
        self._recorder = EpisodeRecorder(
            env.num_envs,
            len(self._sim.body_names),
            env.max_episode_length,
            env.device,
            episodes_per_env=episodes_per_env,
        )
        self._device = env.device

    def record(self, dones: Tensor, infos: dict[str, Any]) -> None:
        self._recorder.record(self._sim.body_pos, self._sim.root_states[:, 3:7])
        ids = dones.to(self._device).nonzero().flatten()
        fell = failures(dones, infos).to(self._device).bool()
        if (diverged := diverged_in(infos, self._device)) is not None:
            fell = fell | diverged  # a divergence counts as a fall
        starts_s = getattr(self._env, "clip_starts_s", None)
        self._recorder.finish(ids, fell[ids], None if starts_s is None else starts_s[ids])

    def result(self) -> ImitationResult:
        return self._metric.evaluate(self._recorder.episodes)


class _GoalProbe:
    """Averages the errors of a task's goal over steps."""

    def __init__(self, env: GoalEnv) -> None:
        self._env = env
        self._sums: dict[str, float] = {}
        self._steps = 0

    def record(self, playing: Tensor, infos: dict[str, Any]) -> None:
        """Add the last step of the environments in `playing` (N,) bool."""
        diverged = diverged_in(infos, playing.device)
        counted = playing if diverged is None else playing & ~diverged
        self._steps += int(counted.sum())
        for name, errors in self._env.goal_errors().items():
            error = errors.to(counted.device)[counted].double().sum().item()
            self._sums[name] = self._sums.get(name, 0.0) + error

    def result(self) -> dict[str, float]:
        return {name: error / max(1, self._steps) for name, error in self._sums.items()}


def evaluate(
    env: Env,
    policy: Policy,
    num_episodes: int,
    style_reward: Callable[[Tensor], Tensor] | None = None,
    on_step: Callable[[Tensor, dict[str, Any]], None] | None = None,
) -> EvaluationResult:
    """Run at least `num_episodes` episodes with a policy and return their measured values.

    Every environment runs the same number of episodes, because the n episodes that end first would
    be too short on average.

    Args:
        env: a task (`VecTask`) whose `reset_done` resets ended episodes.
        policy: returns the actions.
        num_episodes: rounded up to a multiple of the number of environments.
        style_reward: maps `infos["amp_obs"]` (N, F) to rewards (N, 1).
        on_step: is called with the dones (N,) and infos of each step, before resets.
    """
    episodes_per_env = max(1, -(-num_episodes // env.num_envs))
    probe = _ImitationProbe(env, episodes_per_env) if fits(env, ReferenceEnv) else None
    goal = _GoalProbe(env) if fits(env, GoalEnv) else None
    left = torch.full((env.num_envs,), episodes_per_env, device=env.rl_device)
    totals = torch.zeros(4, dtype=torch.float64)  # reward, steps, style reward, falls
    successes: dict[str, float] = {}
    with _evaluated(env):
        env.reset()
        while bool((left > 0).any()):
            rewards, dones, infos = _step(env, policy)
            playing = left > 0
            totals[0] += rewards[playing].double().sum().item()
            totals[1] += int(playing.sum())
            totals[3] += int(failures(dones, infos).bool()[playing].sum())
            for name, values in infos.get("successes", {}).items():
                ended = values[playing & (dones != 0)]
                successes[name] = successes.get(name, 0.0) + ended.double().sum().item()
            if style_reward is not None:
                totals[2] += style_reward(infos["amp_obs"])[playing].double().sum().item()
            if probe is not None:
                probe.record(dones, infos)
            if goal is not None:
                goal.record(playing, infos)
            if on_step is not None:
                on_step(dones, infos)
            left -= (dones != 0).to(left.dtype)
    count = episodes_per_env * env.num_envs
    return EvaluationResult(
        num_episodes=count,
        reward=totals[0].item() / count,
        steps=totals[1].item() / count,
        style_reward=None if style_reward is None else (totals[2] / totals[1]).item(),
        imitation=None if probe is None else probe.result(),
        goal_errors={} if goal is None else goal.result(),
        successes={name: total / count for name, total in successes.items()},
        falls=totals[3].item() / count,
    )


@contextlib.contextmanager
def _evaluated(env: Env) -> Iterator[None]:
    """Clear the flag `is_training` of a task that has this flag, in a `with` statement."""
    before = getattr(env, "is_training", None)
    if before is None:
        yield
        return
    env.is_training = False  # type: ignore[attr-defined]
    try:
        yield
    finally:
        env.is_training = before  # type: ignore[attr-defined]


def _step(env: Env, policy: Policy) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Reset ended episodes and act; return rewards (N,), dones (N,) and infos."""
    obs, _ = env.reset_done()
    with torch.no_grad():
        actions = policy(obs)
    _, rewards, dones, infos = env.step(actions)
    return rewards, dones, infos


def play_on(
    env: Env,
    policy: Policy,
    on_step: Callable[[Tensor, dict[str, Any]], None] | None = None,
) -> None:
    """Run episodes without measuring until the window or web page is closed, or until Ctrl-C."""
    if not getattr(env, "is_watched", False):  # a user's environment may lack it
        return
    log.info("playing on while a window or a page is open; Ctrl-C ends it")
    with contextlib.suppress(KeyboardInterrupt), _evaluated(env):
        while getattr(env, "is_watched", False):
            _, dones, infos = _step(env, policy)
            if on_step is not None:
                on_step(dones, infos)


DEFAULT_EPISODES = 32
# In published train files 100,000 or more episodes mean that the player runs until its window is
# closed.
_ENDLESS = 10_000


def episodes_to_play(player_config: Mapping[str, Any]) -> int:
    """Return `player.games_num` of a train file, or the default if the number means "for ever".

    If a key of the section has no effect, the log names the key.
    """
    if note := player_class_note(player_config):
        log.info("%s", note)
    episodes = int(player_config.get("games_num", DEFAULT_EPISODES))
    if episodes < _ENDLESS:
        return episodes
    log.info(
        "train.params.config.player.games_num=%d means without end; without a window %d episodes"
        " are played",
        episodes,
        DEFAULT_EPISODES,
    )
    return DEFAULT_EPISODES


def evaluate_and_log(
    env: Env, policy: Policy, num_episodes: int, **probes: Any
) -> EvaluationResult:
    """Call `evaluate` and log the result in one line."""
    result = evaluate(env, policy, num_episodes, **probes)
    log.info("played %s", result)
    return result
