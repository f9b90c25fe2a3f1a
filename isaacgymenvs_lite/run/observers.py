"""Puts the observers of a training together, in the order in which they need each other."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.config.launch import LaunchSettings
from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.run.diagnostics import CLIP_LIMITS, DiagnosticsObserver
from isaacgymenvs_lite.run.event_writer import install
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import MetricsObserver
from isaacgymenvs_lite.run.objective import POSE_ERROR, Objective
from isaacgymenvs_lite.run.progress import ProgressObserver
from isaacgymenvs_lite.run.stop_request import StopRequest
from isaacgymenvs_lite.run.task_scalars import TaskScalarsObserver
from isaacgymenvs_lite.utils.state import Stateful

log = logging.getLogger(__name__)


class MultiObserver(Stateful, AlgoObserver):
    """Passes every call on to several observers, in order."""

    def __init__(self, observers: list[AlgoObserver]) -> None:
        super().__init__()
        self.observers = observers

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the observers by the names of their classes."""
        with_state = (each for each in self.observers if isinstance(each, Stateful))
        return {type(each).__name__: each.state_dict() for each in with_state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the observers; another process may have had other observers."""
        for each in self.observers:
            if isinstance(each, Stateful) and type(each).__name__ in state:
                each.load_state_dict(state[type(each).__name__])

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


class TrainingObservers(MultiObserver):
    """All observers of a training: what it shows, and what it writes besides checkpoints.

    Args:
        tree: the resolved tree.
        settings: its root.
        run_name: name of the run folder.
        measurement: plays the mean policy now and then; None: never.
        max_episode_steps: the task's time limit in control steps.
        stop: the user's request to end the training.
        population: compares the policy with others, if there are any.

    Attributes:
        agent: the agent that rl_games' Runner makes and does not return; None before.
        begin: called after the first rollout, in the main process: nothing can be refused by then.
    """

    def __init__(
        self,
        tree: dict[str, Any],
        settings: LaunchSettings,
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
        self._progress = ProgressObserver(stop, metrics, measurement, settings.progress_interval)
        self._wandb = None
        observers: list[AlgoObserver] = [TaskScalarsObserver()]
        if settings.wandb_activate:
            from isaacgymenvs_lite.run.wandb_observer import WandbObserver

            self._wandb = WandbObserver(tree, settings, run_name)
            observers.append(self._wandb)
        if measurement is not None:
            observers.append(measurement)
        clip_limits = [key for key in CLIP_LIMITS if tree["task"]["env"].get(key)]
        diagnostics = DiagnosticsObserver(metrics, measurement, max_episode_steps, clip_limits)
        observers += [metrics, self._progress, diagnostics]
        if not current_group().is_main:  # what they show and write is about all processes
            observers = []
        super().__init__(observers if population is None else [*observers, population])

    def after_init(self, algo: Any) -> None:
        """Store the agent, and guard its TensorBoard writer before the first scalar."""
        self.agent = algo
        if current_group().is_main:
            install(algo.writer)
        super().after_init(algo)

    def after_steps(self) -> None:
        """After each rollout; a request to end in one process ends all."""
        self._stop.requested = current_group().any(self._stop.requested)
        begin, self.begin = self.begin, None
        if begin is not None and current_group().is_main:
            begin()
        super().after_steps()

    def evaluate_end(self) -> None:
        """Measure the last policy, if policies are measured at all; warn if it has got worse."""
        if self._measurement is not None:
            self._measurement.evaluate_end()
            if worsened := self._measurement.worsened():
                log.warning("%s", worsened)

    def best(self, objective: Objective) -> float | None:
        """Return the best number of the run; None if nothing could be measured."""
        measured = self._measurement
        if objective is POSE_ERROR:
            return None if measured is None else measured.best_pose_error_m
        if measured is not None and measured.chooses_best and measured.best_reward is not None:
            return measured.best_reward
        return self._metrics.best_reward

    @property
    def how_best_was_measured(self) -> str:
        """How the best number was measured; '' if in training episodes."""
        measured = self._measurement
        if measured is None or not measured.chooses_best:
            return ""
        return f" after epoch {measured.best_epoch}, without exploration noise"

    @property
    def chooses_best(self) -> bool:
        """Whether a measured reward has chosen the best checkpoint."""
        return self._measurement is not None and self._measurement.chooses_best

    def close_log(self) -> None:
        """End the display of progress, and write the scalars that wait."""
        self._progress.close()
        if self.agent is not None and self.agent.writer is not None:
            self.agent.writer.flush()

    def close_wandb(self) -> None:
        """End the run of Weights & Biases, if there is one."""
        if self._wandb is not None:
            self._wandb.close()
