"""Combines the observers of a training, in the order of their dependencies."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.config.launch import CheckedConfig
from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.errors import SweepError
from isaacgymenvs_lite.run.diagnostics import CLIP_LIMITS, DiagnosticsObserver
from isaacgymenvs_lite.run.event_writer import install
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import MetricsObserver, TaskScalarsObserver
from isaacgymenvs_lite.run.progress import ProgressObserver
from isaacgymenvs_lite.run.stop_request import StopRequest
from isaacgymenvs_lite.utils.state import Stateful

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Objective:
    """The quantity with which sweeps compare runs.

    `direction` is `minimize` or `maximize`, as in Hydra's sweepers.
    """

    name: str
    unit: str
    direction: str

    def check_direction(self, direction: str, task: str) -> None:
        """Check before a training that a study minimises or maximises the result as it should.

        Raises:
            SweepError: `hydra.sweeper.direction` is the opposite direction.
        """
        if direction and direction != self.direction:
            raise SweepError(
                f"hydra.sweeper.direction={direction}: this run of {task} returns its {self.name};"
                f" set hydra.sweeper.direction={self.direction}"
            )

    def describe(self, value: float) -> str:
        """Return a value as text."""
        return f"{self.name} {value:.4g}{self.unit}"


POSE_ERROR = Objective("best pose error", " m", "minimize")
MEAN_REWARD = Objective("best mean reward", "", "maximize")


def objective_of(config: Mapping[str, Any], has_pose_error: bool) -> Objective:
    """Return the quantity with which runs of this `train.params.config` are compared.

    The quantity is the pose error if the pose error is measured and the task's reward has no weight
    (`task_reward_w: 0`, as in AMP). In all other trainings it is the task's reward.
    """
    learns_task = config.get("task_reward_w", 1.0) != 0
    return POSE_ERROR if has_pose_error and not learns_task else MEAN_REWARD


class MultiObserver(Stateful, AlgoObserver):
    """Passes every call on to several observers, in order."""

    def __init__(self, observers: list[AlgoObserver]) -> None:
        super().__init__()
        self.observers = observers

    def state_dict(self) -> dict[str, Any]:
        """Return a dictionary from the name of each observer's class to the observer's state."""
        with_state = (each for each in self.observers if isinstance(each, Stateful))
        return {type(each).__name__: each.state_dict() for each in with_state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the observers that the state contains."""
        for each in self.observers:
            if isinstance(each, Stateful) and type(each).__name__ in state:
                each.load_state_dict(state[type(each).__name__])

    def _call(self, name: str, *arguments: Any) -> None:
        for observer in self.observers:
            # rl_games calls `after_clear_stats`, but its base class lacks it.
            getattr(observer, name, lambda: None)(*arguments)

    def before_init(self, base_name: str, config: dict[str, Any], experiment_name: str) -> None:
        """Call the observers before the agent builds anything."""
        self._call("before_init", base_name, config, experiment_name)

    def after_init(self, algo: Any) -> None:
        """Call the observers when the agent is complete."""
        self._call("after_init", algo)

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Call the observers after each environment step."""
        self._call("process_infos", infos, done_indices)

    def after_steps(self) -> None:
        """Call the observers after each rollout."""
        self._call("after_steps")

    def after_clear_stats(self) -> None:
        """Call the observers when the agent's meters were cleared."""
        self._call("after_clear_stats")

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Call the observers after each epoch."""
        self._call("after_print_stats", frame, epoch_num, total_time)


class TrainingObservers(MultiObserver):
    """All observers of a training.

    Attributes:
        agent: the agent, which rl_games' Runner makes but does not return; None until the Runner
            has made the agent.
        begin: called in the main process after the first rollout, when all settings have been
            accepted.
    """

    def __init__(
        self,
        config: CheckedConfig,
        run_name: str,
        measurement: MeasurementObserver | None,
        max_episode_steps: int,
        stop: StopRequest,
        population: AlgoObserver | None = None,
    ) -> None:
        self._metrics = metrics = MetricsObserver()
        self._measurement = measurement
        self.agent: Any = None
        self.begin: Callable[[], None] | None = None
        self._stop = stop
        interval_s = config.settings.progress_interval
        self._progress = ProgressObserver(stop, metrics, measurement, interval_s)
        self._wandb = None
        observers: list[AlgoObserver] = [TaskScalarsObserver()]
        if config.settings.wandb_activate:
            from isaacgymenvs_lite.run.wandb_observer import WandbObserver

            self._wandb = WandbObserver(config.tree, config.settings, run_name)
            observers.append(self._wandb)
        if measurement is not None:
            observers.append(measurement)
        clip_limits = [key for key in CLIP_LIMITS if config.tree["task"]["env"].get(key)]
        diagnostics = DiagnosticsObserver(metrics, measurement, max_episode_steps, clip_limits)
        observers += [metrics, self._progress, diagnostics]
        if not current_group().is_main:  # the main process shows and writes for all processes
            observers = []
        super().__init__(observers if population is None else [*observers, population])

    def after_init(self, algo: Any) -> None:
        """Store the agent, and install our event writer before the first scalar."""
        self.agent = algo
        if current_group().is_main:
            install(algo.writer)
        super().after_init(algo)

    def after_steps(self) -> None:
        """Call the observers after each rollout; a stop request in one process stops all."""
        self._stop.requested = current_group().any(self._stop.requested)
        begin, self.begin = self.begin, None
        if begin is not None and current_group().is_main:
            begin()
        super().after_steps()

    def evaluate_end(self) -> None:
        """Measure the last policy if policies are measured; warn if it is worse than the best."""
        if self._measurement is not None:
            self._measurement.evaluate_end()
            if worsened := self._measurement.worsened():
                log.warning("%s", worsened)

    def best(self, objective: Objective) -> float | None:
        """Log and return the best result of the run; None if nothing could be measured."""
        measured, how = self._measurement, ""
        best = self._metrics.best_reward
        if objective is POSE_ERROR:
            best = None if measured is None else measured.best_pose_error_m
        elif measured is not None and measured.chooses_best and measured.best_reward is not None:
            best = measured.best_reward
            how = f" after epoch {measured.best_epoch}, without exploration noise"
        if best is not None:
            log.info("%s%s", objective.describe(best), how)
        return best

    @property
    def chooses_best(self) -> bool:
        """Whether a measured reward has chosen the best checkpoint."""
        return self._measurement is not None and self._measurement.chooses_best

    def close_log(self) -> None:
        """Close the progress bar and write the remaining scalars."""
        self._progress.close()
        if self.agent is not None and self.agent.writer is not None:
            self.agent.writer.flush()

    def close_wandb(self) -> None:
        """End the run of Weights & Biases, if there is one."""
        if self._wandb is not None:
            self._wandb.close()
