"""Says in the log and in TensorBoard when a training goes wrong in a known way."""

from __future__ import annotations

import logging
import time
from typing import Any

from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite.run.diagnostics import Diagnostics
from isaacgymenvs_lite.run.history import Measurement
from isaacgymenvs_lite.run.imitation import ImitationObserver
from isaacgymenvs_lite.run.metrics import MetricsObserver

log = logging.getLogger(__name__)


class DiagnosticsObserver(AlgoObserver):
    """Feeds an `Diagnostics` and logs what it has to say, as a warning and as the text `advice`.

    Stands behind the observers that it reads. Numbers that are not finite do not come so far: the
    agents end the run before (`learning.safeguards`).

    Args:
        figures: the epochs' figures.
        imitation: the measured pose error, if any.
        max_episode_steps: the task's time limit in control steps.
    """

    def __init__(
        self,
        figures: MetricsObserver,
        imitation: ImitationObserver | None,
        max_episode_steps: int,
    ) -> None:
        super().__init__()
        self._figures = figures
        self._imitation = imitation
        self._max_episode_steps = max_episode_steps

    def after_init(self, algo: Any) -> None:
        """Take the agent."""
        self._algo = algo
        self._advisor = Diagnostics(algo.config, self._max_episode_steps)
        self._measured_at: int | None = None

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Pass on what is new, and say what has to be said."""
        del epoch_num, total_time
        if self._figures.latest is None:
            return
        self._advisor.add_epoch(self._figures.latest)
        self._add_measurement()
        sentence = self._advisor.sentence(time.monotonic())
        if sentence is not None:
            log.warning("%s", sentence)
            self._algo.writer.add_text("advice", sentence, frame)

    def _add_measurement(self) -> None:
        observer = self._imitation
        if observer is None or observer.last_frame == self._measured_at:
            return
        self._measured_at = observer.last_frame
        result = observer.last.imitation if observer.last is not None else None
        if result is not None and observer.last_frame is not None:
            self._advisor.add_measurement(
                Measurement(
                    frame=observer.last_frame,
                    pose_error_m=result.pose_error_m,
                    tempo=result.tempo,
                    no_fall_share=result.no_fall_share,
                    clip_spread_m=observer.clip_spread_m,
                )
            )
