"""What a training run shows: progress, the environment's scalars, the imitation metric, wandb.

Observers are rl_games' `AlgoObserver`s; `MultiObserver` makes one of several.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from rl_games.algos_torch.torch_ext import AverageMeter
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor
from tqdm import tqdm

from isaacgymenvs_lite.learning.evaluation import EvaluationResult, evaluate
from isaacgymenvs_lite.stopping import StopRequest

log = logging.getLogger(__name__)


class MultiObserver(AlgoObserver):
    """Passes every call on to several observers, in order."""

    def __init__(self, observers: list[AlgoObserver]) -> None:
        super().__init__()
        self.observers = observers

    def before_init(self, base_name: str, config: dict[str, Any], experiment_name: str) -> None:
        """Before the agent builds anything."""
        for observer in self.observers:
            observer.before_init(base_name, config, experiment_name)

    def after_init(self, algo: Any) -> None:
        """The agent is complete."""
        for observer in self.observers:
            observer.after_init(algo)

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """After each environment step."""
        for observer in self.observers:
            observer.process_infos(infos, done_indices)

    def after_steps(self) -> None:
        """After each rollout."""
        for observer in self.observers:
            observer.after_steps()

    def after_clear_stats(self) -> None:
        """The agent's meters were cleared."""
        for observer in self.observers:
            # rl_games calls it on the outermost observer, but its base class lacks it.
            getattr(observer, "after_clear_stats", lambda: None)()

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """After each epoch."""
        for observer in self.observers:
            observer.after_print_stats(frame, epoch_num, total_time)


class TaskScalarsObserver(AlgoObserver):
    """Writes what tasks put into infos, as IsaacGymEnvs' RLGPUAlgoObserver.

    `Episode/<key>`: means of infos["episode"]; `episode_cumulative/<key>` (and _min, _max): sums
    of infos["episode_cumulative"] over an episode; every scalar in infos, nested keys joined by
    "/", as `<key>/frame`, `/iter`, `/time`.
    """

    def after_init(self, algo: Any) -> None:
        """Take the agent's writer and device."""
        self._algo = algo
        self._episode_infos: list[dict[str, Any]] = []
        self._scalars: dict[str, float] = {}
        self._running: dict[str, Tensor] = {}
        self._finished: dict[str, list[float]] = {}

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Collect; infos must be a dictionary.

        Raises:
            TypeError: it is not.
        """
        if not isinstance(infos, dict):
            raise TypeError(f"infos must be a dictionary, got {type(infos).__name__}")
        if "episode" in infos:
            self._episode_infos.append(infos["episode"])
        if "episode_cumulative" in infos:
            self._accumulate(infos["episode_cumulative"], done_indices.flatten())
        self._scalars = dict(_flat_scalars(infos))

    def _accumulate(self, values: dict[str, Tensor], done_ids: Tensor) -> None:
        for key, value in values.items():
            total = self._running.setdefault(key, torch.zeros_like(value))
            total += value
            finished = self._finished.setdefault(key, [])
            finished += total[done_ids].tolist()
            del finished[: -self._algo.games_to_track]
            total[done_ids] = 0

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Write what was collected."""
        writer = self._algo.writer
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


class ImitationObserver(AlgoObserver):
    """Every so many epochs plays the mean policy and writes `imitation/pose_error_m`.

    The episodes start from the same states each time (a fixed seed of their own), on simulations
    of their own, so that training is not disturbed and numbers compare over time. The first one
    tells what an evaluation costs; later ones are put off while all together would take more than
    2% of the time trained.

    Args:
        make_env: makes the evaluation's task, given its number of environments.
        frequency: epochs between evaluations; 0 = never.
        num_episodes: episodes of one evaluation, all at the same time.
    """

    MAX_TIME_SHARE = 0.02
    _SEED = 1234

    def __init__(self, make_env: Callable[[int], Any], frequency: int, num_episodes: int) -> None:
        super().__init__()
        self._make_env = make_env
        self._frequency = frequency
        self._num_episodes = num_episodes
        self._env: Any = None
        self._spent_s = 0.0
        self._evaluations = 0
        self._epochs = 0
        self._due = False
        self.last: EvaluationResult | None = None

    def after_init(self, algo: Any) -> None:
        """Take the agent and start the clock."""
        self._algo = algo
        self._start_s = time.monotonic()

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Evaluate if it is time."""
        del total_time
        if self._frequency == 0:
            return
        self._epochs += 1
        self._due |= self._epochs % self._frequency == 0
        trained_s = time.monotonic() - self._start_s - self._spent_s
        # The last evaluation tells what the next one will cost.
        expected_s = self._spent_s / max(1, self._evaluations)
        if not self._due or self._spent_s + expected_s > self.MAX_TIME_SHARE * trained_s:
            return
        self._due = False
        start = time.monotonic()
        self.last = self._evaluate()
        self._spent_s += time.monotonic() - start
        self._evaluations += 1
        self._write(self.last, frame)

    def _evaluate(self) -> EvaluationResult:
        with torch.random.fork_rng(enabled=True):
            if self._env is None:
                self._env = self._make_env(self._num_episodes)
            torch.manual_seed(self._SEED)
            return evaluate(self._env, self._act, self._num_episodes)

    def _act(self, obs: dict[str, Tensor]) -> Tensor:
        algo = self._algo
        means = algo.get_action_values(algo.obs_to_tensors(obs))["mus"].float()
        return algo.preprocess_actions(means)

    def _write(self, result: EvaluationResult, frame: int) -> None:
        writer = self._algo.writer
        writer.add_scalar("imitation/episode_steps", result.steps, frame)
        if result.imitation is not None:
            writer.add_scalar("imitation/pose_error_m", result.imitation.pose_error_m, frame)
            writer.add_scalar("imitation/no_fall_share", result.imitation.no_fall_share, frame)
            writer.add_scalar("imitation/tempo", result.imitation.tempo, frame)
        log.info("after %d frames: %s", frame, result)


class ProgressObserver(AlgoObserver):
    """A progress bar on a terminal, a line every few seconds elsewhere; and the stop at Ctrl-C.

    Args:
        stop: asked for by the user; the epoch that hears of it is made the last one.
        imitation: whose newest pose error is shown, if any.
        line_interval_s: seconds between lines where the output is no terminal.
    """

    def __init__(
        self,
        stop: StopRequest,
        imitation: ImitationObserver | None = None,
        line_interval_s: float = 10.0,
    ) -> None:
        super().__init__()
        self._stop = stop
        self._imitation = imitation
        self._line_interval_s = line_interval_s
        self._bar: tqdm | None = None

    def after_init(self, algo: Any) -> None:
        """Take the agent."""
        self._algo = algo
        self._start_s = self._last_line_s = self._last_epoch_s = time.monotonic()
        self._first_line = True
        self._first_epoch: int | None = None
        self._frames_per_s = AverageMeter(1, 10)

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Show how far the training is; end it if a stop was asked for."""
        del frame, total_time
        algo = self._algo
        now = time.monotonic()
        fps = algo.curr_frames / max(now - self._last_epoch_s, 1e-9)
        self._frames_per_s.update(torch.tensor([fps]))
        self._last_epoch_s = now
        if self._first_epoch is None:
            self._first_epoch = epoch_num
        shown = self._values()
        if sys.stderr.isatty():
            self._update_bar(epoch_num, shown)
        elif self._first_line or now - self._last_line_s >= self._line_interval_s:
            self._write_line(epoch_num, shown, now)
        if self._stop.requested:
            # rl_games ends at max_epochs by saving a last checkpoint: just what is wanted.
            algo.max_epochs = epoch_num

    def _values(self) -> dict[str, str]:
        algo = self._algo
        shown = {"fps": f"{self._frames_per_s.mean.item():,.0f}"}
        if algo.game_lengths.current_size > 0:
            shown["episode length"] = f"{algo.game_lengths.mean.item():.0f}"
            shown["reward"] = f"{algo.game_rewards.mean.flatten()[0].item():.2f}"
        if hasattr(algo, "train_info_means"):
            style = algo.train_info_means().get("disc_reward_mean")
            if style is not None:
                shown["style reward"] = f"{style:.3f}"
        result = self._imitation.last if self._imitation is not None else None
        if result is not None and result.imitation is not None:
            shown["pose error"] = f"{result.imitation.pose_error_m:.3f} m"
        return shown

    def _update_bar(self, epoch_num: int, shown: dict[str, str]) -> None:
        if self._bar is None:
            total = self._algo.max_epochs if self._algo.max_epochs > 0 else None
            first = epoch_num - 1
            self._bar = tqdm(total=total, initial=first, unit="epoch", dynamic_ncols=True)
        self._bar.set_postfix(shown, refresh=False)
        self._bar.update(epoch_num - self._bar.n)

    def _write_line(self, epoch_num: int, shown: dict[str, str], now: float) -> None:
        self._first_line = False
        self._last_line_s = now
        total = self._algo.max_epochs
        progress = f"epoch {epoch_num}"
        if total > 0:
            made = epoch_num - (self._first_epoch or epoch_num) + 1
            left_s = (total - epoch_num) * (now - self._start_s) / made
            progress = f"epoch {epoch_num}/{total}, ETA {_clock(left_s)}"
        log.info("%s, %s", progress, ", ".join(f"{key} {value}" for key, value in shown.items()))

    def close(self) -> None:
        """Leave the terminal in order."""
        if self._bar is not None:
            self._bar.close()


def _clock(seconds: float) -> str:
    minutes, secs = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{secs:02d}"
