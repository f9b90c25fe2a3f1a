"""Lines about a training, for libraries that say nothing where there is no terminal."""

from __future__ import annotations

import logging
import time
from collections import deque

from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

log = logging.getLogger(__name__)

_NUM_EPISODES = 100


class ProgressLines:
    """A `StepListener` that logs progress and the last episodes every few seconds.

    Args:
        stepper: steps the task.
        num_steps: control steps of the training.
        interval_s: from one line to the next.
    """

    def __init__(self, stepper: AutoresetTask, num_steps: int, interval_s: float = 10.0) -> None:
        self._stepper = stepper
        self._num_steps = num_steps
        self._interval_s = interval_s
        self._first_step = stepper.num_steps
        self._returns: deque[float] = deque(maxlen=_NUM_EPISODES)
        self._lengths: deque[int] = deque(maxlen=_NUM_EPISODES)
        self._start_s = self._last_line_s = time.monotonic()

    def after_step(self) -> None:
        """Count the episodes that the step before this one ended; say something if it is time."""
        if self._stepper.last_step is not None:
            ended = self._stepper.last_step.episodes
            self._returns.extend(ended.returns.tolist())
            self._lengths.extend(ended.lengths.tolist())
        now_s = time.monotonic()
        if now_s - self._last_line_s >= self._interval_s:
            self._last_line_s = now_s
            log.info("%s", self._line(now_s - self._start_s))

    def render(self) -> None:
        """Do nothing: there is nothing to show."""

    def close(self) -> None:
        """Do nothing: nothing is open."""

    def _line(self, passed_s: float) -> str:
        steps = self._stepper.num_steps - self._first_step + 1
        frames_per_s = steps * self._stepper.num_envs / passed_s
        parts = [f"step {steps}/{self._num_steps}", f"fps {frames_per_s:,.0f}"]
        if self._returns:
            count = len(self._returns)
            parts.append(f"episode length {sum(self._lengths) / count:.0f}")
            parts.append(f"reward {sum(self._returns) / count:.2f}")
        return ", ".join(parts)
