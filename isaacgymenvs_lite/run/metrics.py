"""Computes the metrics of an epoch for all observers, and writes the scalars of a task."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from rl_games.algos_torch.torch_ext import AverageMeter
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.env_interface import diverged_in, reports_divergence
from isaacgymenvs_lite.utils.state import Stateful


@dataclass(frozen=True)
class EpochMetrics:
    """The metrics of an epoch. A metric that the agent or the task lacks is None.

    Attributes:
        epoch: number of the epoch.
        frame: environment steps before the epoch, including the steps of the run that was resumed.
        episode_steps: mean length of the last episodes in control steps.
        episode_reward: mean sum of the task's rewards of the last episodes.
        fall_rate: share of the last episodes that ended by a fall, 0 to 1. For a task without
            `terminate`, an episode that ended before the time limit counts as a fall.
        off_clip_rate: share of the last episodes that ended because the character left its clip.
        train_info: `CommonAgent.train_info_means`; empty for the agents of rl_games.
        successes: means of `VecTask.episode_successes` at the ends of the last episodes.
    """

    epoch: int
    frame: int
    episode_steps: float | None = None
    episode_reward: float | None = None
    fall_rate: float | None = None
    off_clip_rate: float | None = None
    train_info: Mapping[str, float] = field(default_factory=dict)
    successes: Mapping[str, float] = field(default_factory=dict)

    @property
    def early_end_rate(self) -> float | None:
        """Share of the last episodes that ended by a fall or because of leaving the clip."""
        return None if self.fall_rate is None else self.fall_rate + (self.off_clip_rate or 0.0)

    @property
    def style_reward(self) -> float | None:
        """Mean style reward per step."""
        return self.train_info.get("disc_reward_mean")

    @property
    def disc_accuracy(self) -> float | None:
        """Balanced accuracy of the discriminator, from 0 to 1; random guesses have 0.5."""
        info = self.train_info
        if "disc_agent_acc" not in info or "disc_demo_acc" not in info:
            return None
        return 0.5 * (info["disc_agent_acc"] + info["disc_demo_acc"])


class MetricsObserver(Stateful, AlgoObserver):
    """Stores the newest `EpochMetrics` and writes some of them, for example `info/fall_rate`.

    Falls and successes are averaged over the same episodes as rl_games' mean length and reward
    (`games_to_track`). This observer must come before the observers that read `latest`.
    """

    latest: EpochMetrics | None = None
    best_reward: float | None = None
    stored = ("best_reward",)

    def after_init(self, algo: Any) -> None:
        """Store the agent."""
        self._algo = algo
        self._falls, self._off_clip = self._new_meter(), self._new_meter()
        self._successes: dict[str, AverageMeter] = {}

    def _new_meter(self) -> AverageMeter:
        return AverageMeter(1, self._algo.games_to_track).to(self._algo.ppo_device)

    def state_dict(self) -> dict[str, Any]:
        """Return the state, including the counted episodes."""
        return {
            **super().state_dict(),
            "meters": [_counted(self._falls), _counted(self._off_clip)],
            "successes": {name: _counted(meter) for name, meter in self._successes.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state."""
        own = ("meters", "successes")
        super().load_state_dict({n: part for n, part in state.items() if n not in own})
        successes = state.get("successes", {})  # older checkpoints have none
        self._successes = {name: self._new_meter() for name in successes}
        meters = (self._falls, self._off_clip, *self._successes.values())
        counted = (*state["meters"], *successes.values())
        for meter, (mean, size) in zip(meters, counted, strict=True):
            meter.mean.copy_(mean)
            meter.current_size = int(size)

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Count how the episodes of `done_indices` (n, 1) ended."""
        rows = done_indices.flatten()
        if (diverged := diverged_in(infos, rows.device)) is not None:
            rows = rows[~diverged[rows]]  # the rates leave out diverged episodes
        off_clip = infos["off_clip"][rows].bool() if "off_clip" in infos else None
        if "terminate" in infos:
            fell = infos["terminate"][rows].bool()
            self._falls.update((fell if off_clip is None else fell & ~off_clip).unsqueeze(1))
        elif "time_outs" in infos:
            self._falls.update(~infos["time_outs"][rows].bool().unsqueeze(1))
        if off_clip is not None:
            self._off_clip.update(off_clip.unsqueeze(1))
        for name, values in infos.get("successes", {}).items():
            if name not in self._successes:
                self._successes[name] = self._new_meter()
            self._successes[name].update(values[rows].float().unsqueeze(1))

    def after_clear_stats(self) -> None:
        """Drop the episodes after the agent's meters have been cleared."""
        for meter in (self._falls, self._off_clip, *self._successes.values()):
            meter.clear()

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Read the metrics of the epoch."""
        algo = self._algo
        has_episodes = algo.game_lengths.current_size > 0
        self.latest = latest = EpochMetrics(
            epoch=epoch_num,
            frame=frame,
            episode_steps=algo.game_lengths.mean.item() if has_episodes else None,
            episode_reward=algo.game_rewards.mean.flatten()[0].item() if has_episodes else None,
            fall_rate=_mean(self._falls),
            off_clip_rate=_mean(self._off_clip),
            train_info=algo.train_info_means() if hasattr(algo, "train_info_means") else {},
            successes={n: m.mean.item() for n, m in self._successes.items() if m.current_size > 0},
        )
        if latest.episode_reward is not None:
            best = self.best_reward
            self.best_reward = max(latest.episode_reward, -math.inf if best is None else best)
        for tag, value in (
            ("info/fall_rate", latest.fall_rate),
            ("info/off_clip_rate", latest.off_clip_rate),
            ("info/disc_acc", latest.disc_accuracy),
            *((f"success/{name}", value) for name, value in latest.successes.items()),
        ):
            if value is not None:
                algo.writer.add_scalar(tag, value, frame)


def _counted(meter: AverageMeter) -> list[Any]:
    return [meter.mean.cpu().clone(), meter.current_size]


def _mean(meter: AverageMeter) -> float | None:
    return meter.mean.item() if meter.current_size > 0 else None


class TaskScalarsObserver(Stateful, AlgoObserver):
    """Writes a task's infos to TensorBoard, with the tags of IsaacGymEnvs' RLGPUAlgoObserver.

    - `Episode/<key>`: means of infos["episode"].
    - `episode_cumulative/<key>`, `_min/<key>_min` and `_max/<key>_max`: sums of
      infos["episode_cumulative"] over an episode.
    - `<key>/frame`, `<key>/iter` and `<key>/time`: every scalar in infos; nested keys are joined
      by "/".
    - `sim/diverged`: the number of simulations that diverged in the epoch, from infos["diverged"]
      (N,) bool. Their episodes are left out of all means.
    - `reward_terms/<name>`: each term of a reward with several terms, as the mean over environments
      and steps of the epoch. In a hierarchy the mean is over one low-level step of each high-level
      action.
    """

    stored = ("_running", "_finished")

    def after_init(self, algo: Any) -> None:
        """Store the agent and clear all values."""
        self._algo = algo
        self._episode_infos: list[dict[str, Any]] = []
        self._scalars: dict[str, float] = {}
        self._running: dict[str, Tensor] = {}
        self._finished: dict[str, list[float]] = {}
        self._diverged: int | None = None
        self._terms: dict[str, Tensor] = {}
        self._steps = 0

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Collect the values of a step."""
        diverged = diverged_in(infos, done_indices.device)
        if reports_divergence(infos.get("diverged")):
            found = 0 if diverged is None else int(diverged.sum())
            self._diverged = (self._diverged or 0) + found
        if "episode" in infos:
            self._episode_infos.append(infos["episode"])
        if "episode_cumulative" in infos:
            self._accumulate(infos["episode_cumulative"], done_indices.flatten(), diverged)
        self._scalars = dict(_flat_scalars(infos))
        task = getattr(getattr(self._algo, "vec_env", None), "env", None)
        terms = getattr(task, "reward_terms", {})
        if len(terms) > 1:  # a single term is the reward itself
            self._steps += 1
            for name, term in terms.items():
                self._terms[name] = self._terms.get(name, 0.0) + term.mean()

    def _accumulate(
        self, values: dict[str, Tensor], done_ids: Tensor, diverged: Tensor | None
    ) -> None:
        counted = done_ids
        if diverged is not None:
            counted = done_ids[~diverged[done_ids]]
        for key, value in values.items():
            total = self._running.setdefault(key, torch.zeros_like(value))
            total += value
            finished = self._finished.setdefault(key, [])
            finished += total[counted].tolist()
            del finished[: -self._algo.games_to_track]
            total[done_ids] = 0

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Write the collected values."""
        writer = self._algo.writer
        if self._diverged is not None:
            writer.add_scalar("sim/diverged", self._diverged, frame)
            self._diverged = 0
        for name, sum_of_means in self._terms.items():
            writer.add_scalar(f"reward_terms/{name}", float(sum_of_means) / self._steps, frame)
        self._terms.clear()
        self._steps = 0
        if self._episode_infos:
            for key in self._episode_infos[0]:
                values = [torch.as_tensor(i[key]).float().flatten() for i in self._episode_infos]
                writer.add_scalar(f"Episode/{key}", torch.cat(values).mean().item(), epoch_num)
            self._episode_infos.clear()
        for key, finished in self._finished.items():
            if finished:
                mean = sum(finished) / len(finished)
                writer.add_scalar(f"episode_cumulative/{key}", mean, frame)
                writer.add_scalar(f"episode_cumulative_min/{key}_min", min(finished), frame)
                writer.add_scalar(f"episode_cumulative_max/{key}_max", max(finished), frame)
        for key, value in self._scalars.items():
            writer.add_scalar(f"{key}/frame", value, frame)
            writer.add_scalar(f"{key}/iter", value, epoch_num)
            writer.add_scalar(f"{key}/time", value, total_time)


def _flat_scalars(infos: dict[str, Any], prefix: str = "") -> list[tuple[str, float]]:
    found: list[tuple[str, float]] = []
    for key, value in infos.items():
        if key in ("episode", "episode_cumulative"):
            continue
        if isinstance(value, dict):
            found += _flat_scalars(value, f"{prefix}{key}/")
        elif isinstance(value, (int, float)) or (isinstance(value, Tensor) and value.ndim == 0):
            found.append((f"{prefix}{key}", float(value)))
    return found
