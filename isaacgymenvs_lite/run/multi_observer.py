"""Several observers as one."""

from __future__ import annotations

from typing import Any

from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor


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
