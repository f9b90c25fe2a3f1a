"""Measures the mean policy at intervals during a training, and keeps the best policy."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from typing import Any

import torch
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.env_interface import ReferenceEnv, fits
from isaacgymenvs_lite.evaluation.body_tracks import tracks_of_clips
from isaacgymenvs_lite.evaluation.evaluate import EvaluationResult, evaluate
from isaacgymenvs_lite.evaluation.pose_error import ReferencePoses
from isaacgymenvs_lite.utils.state import Stateful

log = logging.getLogger(__name__)


def clip_spread_m(reference: ReferencePoses) -> float:
    """Return the smallest spread (m) of a clip: the mean distance of its poses from their average.

    The spread is near 0 for a clip without motion, which a standing policy imitates well.
    """
    return min((clip - clip.mean(dim=0)).norm(dim=-1).mean().item() for clip in reference.clips)


# A policy that may become the best checkpoint is measured after this time (s), even if epochs take
# so long that `frequency` epochs are not over.
_LONGEST_WAIT_S = 180.0
_NOTABLE = 0.1
"""A last policy is reported if it loses more than this share of the best reward."""


class MeasurementObserver(Stateful, AlgoObserver):
    """Runs episodes with the mean policy at intervals and writes `imitation/pose_error_m`.

    The observer also writes the errors of a task's goal, for example `goal/velocity_error_m_s`. For
    a task without reference motions it writes `measured/reward`, and the policy with the highest
    measured reward is the run's best checkpoint. If the task counts successes, more successes come
    first, and the reward decides between equal policies. rl_games would choose the
    checkpoint by the last training episodes, which may be many epochs old.

    The evaluation has a separate simulation, so that it does not disturb the training. Its fixed
    seed makes all evaluations start from the same states. An evaluation is postponed while all
    evaluations together would take more than a small share of the training time.

    Args:
        make_env: maps a number of environments to a task for the evaluation.
        frequency: epochs between evaluations; 0 for no evaluations. If the measurements choose the
            best checkpoint, there are also evaluations after `_LONGEST_WAIT_S`.
        num_episodes: episodes of one evaluation, which run at the same time.
        chooses_best: whether the measured reward chooses the best checkpoint.

    Attributes:
        last: the newest result, or None before the first evaluation.
        last_frame: environment steps before the newest evaluation.
        best_pose_error_m: the lowest pose error in m, or None before the first pose error.
        clip_spread_m: `clip_spread_m` of the task's clips, nan before the first evaluation.
        implausible: implausible motions in the clips, '' before the first evaluation.
    """

    MAX_TIME_SHARE = 0.02
    _SHARE_TO_CHOOSE = 0.1  # so large that a training of a few seconds also gets measurements
    _SEED = 1234
    best_pose_error_m: float | None = None
    best_reward: float | None = None
    best_success = 0.0
    best_epoch = 0
    stored = ("best_pose_error_m", "best_reward", "best_success", "best_epoch")

    def __init__(
        self,
        make_env: Callable[[int], Any],
        frequency: int,
        num_episodes: int,
        chooses_best: bool = False,
    ) -> None:
        super().__init__()
        self._make_env = make_env
        self._frequency, self._num_episodes = frequency, num_episodes
        self.chooses_best = chooses_best
        self._env: Any = None
        self._spent_s = 0.0
        self._evaluations = self._epochs = self._measured_epochs = 0
        self._frame = self._epoch = 0
        self._due = False
        self.last: EvaluationResult | None = None
        self.last_frame: int | None = None
        self.clip_spread_m = math.nan
        self.implausible = ""

    def after_init(self, algo: Any) -> None:
        """Store the agent and start the clock."""
        self._algo = algo
        self._start_s = self._measured_s = time.monotonic()
        # Agents of other projects may lack `save_best`.
        self.chooses_best &= hasattr(algo, "save_best")
        if self.chooses_best:
            algo.best_is_measured = True

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Evaluate the policy if an evaluation is due."""
        if self._frequency == 0:
            return
        self._epochs += 1
        self._frame, self._epoch = frame, epoch_num
        since_s = time.monotonic() - self._measured_s
        self._due |= self._epochs % self._frequency == 0
        self._due |= self.chooses_best and since_s > _LONGEST_WAIT_S
        trained_s = time.monotonic() - self._start_s - self._spent_s
        # The next evaluation is expected to take the average time of the previous evaluations.
        expected_s = self._spent_s / max(1, self._evaluations)
        share = self._SHARE_TO_CHOOSE if self.chooses_best else self.MAX_TIME_SHARE
        if not self._due or self._spent_s + expected_s > share * trained_s:
            return
        self._due = False
        start = time.monotonic()
        self._evaluate()
        self._spent_s += time.monotonic() - start
        self._evaluations += 1

    def evaluate_end(self) -> None:
        """Evaluate the policy at the end of the training, unless the last epoch was evaluated."""
        if self._epochs > self._measured_epochs:
            self._evaluate()

    def _evaluate(self) -> None:
        self._measured_epochs = self._epochs
        self._measured_s = time.monotonic()
        self.last, self.last_frame = result, frame = self.measure(), self._frame
        measured = result.imitation
        if measured is not None and math.isfinite(measured.pose_error_m):
            best = self.best_pose_error_m
            self.best_pose_error_m = min(measured.pose_error_m, math.inf if best is None else best)
        success = sum(result.successes.values())
        best = (self.best_success, self.best_reward)
        if best[1] is None or (success, result.reward) > best:
            self.best_success, self.best_reward = success, result.reward
            self.best_epoch = self._epoch
            if self.chooses_best:
                self._algo.save_best()
        self._write(result, frame)

    def worsened(self) -> str:
        """Return a sentence if the last policy is worse than the best policy, otherwise ''."""
        if self.last is None or self.best_reward is None or not self.chooses_best:
            return ""
        lost = self.best_reward - self.last.reward
        lost_success = self.best_success - sum(self.last.successes.values())
        if lost_success > _NOTABLE * self.best_success:
            return (
                f"the last policy succeeds less often than the best one, after epoch"
                f" {self.best_epoch}"
            )
        if self.last.successes or lost <= _NOTABLE * abs(self.best_reward):
            return ""
        return (
            f"the last policy earns {self.last.reward:.4g}, less than the best one"
            f" ({self.best_reward:.4g}, after epoch {self.best_epoch})"
        )

    def measure(self) -> EvaluationResult:
        """Run the episodes of one evaluation with the mean policy and return the result."""
        with torch.random.fork_rng(enabled=True):
            if self._env is None:
                self._env = env = self._make_env(self._num_episodes)
                if fits(env, ReferenceEnv):
                    reference = ReferencePoses.from_tracks(tracks_of_clips(env.motion_lib, env.dt))
                    self.clip_spread_m = clip_spread_m(reference)
                    self.implausible = "; ".join(env.motion_lib.implausible.values())
            torch.manual_seed(self._SEED)
            policy = self._means_of_rl_games
            if hasattr(self._algo, "mean_policy"):
                policy = self._algo.mean_policy(self._env)
            return evaluate(self._env, policy, self._num_episodes)

    def _means_of_rl_games(self, obs: dict[str, Tensor]) -> Tensor:
        algo = self._algo
        means = algo.get_action_values(algo.obs_to_tensors(obs))["mus"].float()
        return algo.preprocess_actions(means)

    def _write(self, result: EvaluationResult, frame: int) -> None:
        measured = result.imitation
        if measured is not None:
            scalars = {
                "imitation/episode_steps": result.steps,
                "imitation/pose_error_m": measured.pose_error_m,
                "imitation/no_fall_share": measured.no_fall_share,
                "imitation/tempo": measured.tempo,
                "imitation/motion_shown": measured.motion_shown,
            }
        else:
            scalars = {
                "measured/reward": result.reward,
                "measured/episode_steps": result.steps,
                "measured/fall_rate": result.falls,
            }
        scalars |= {f"goal/{name}": error for name, error in result.goal_errors.items()}
        scalars |= {f"success/measured_{name}": mean for name, mean in result.successes.items()}
        for tag, value in scalars.items():
            self._algo.writer.add_scalar(tag, value, frame)
        # rl_games counts the frames before the epoch, so scalars have this count; the log shows the
        # current count.
        trained = self._algo.frame // getattr(self._algo, "num_agents", 1)
        log.info("after %d frames, without exploration noise: %s", trained, result)
