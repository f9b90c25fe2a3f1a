"""Shows the progress of a training as a bar or as lines, and ends the training at Ctrl-C."""

from __future__ import annotations

import logging
import sys
import time
from typing import Any

import torch
from rl_games.algos_torch.torch_ext import AverageMeter
from rl_games.common.algo_observer import AlgoObserver
from tqdm import tqdm

from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import MetricsObserver
from isaacgymenvs_lite.run.stop_request import StopRequest

log = logging.getLogger(__name__)

_ESTIMATE_AFTER_S = 20.0  # the first epochs of a training are slower

# tqdm's default format without elapsed time and rate leaves room for the metrics.
_BAR_FORMAT = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{remaining}{postfix}]"


class ProgressObserver(AlgoObserver):
    """Shows a progress bar in a terminal, else lines; ends the training at Ctrl-C.

    Without a terminal there is a line every few seconds, and always for the first and last epoch.
    The epoch in which the user requests the end becomes the last epoch.
    """

    def __init__(
        self,
        stop: StopRequest,
        metrics: MetricsObserver,
        imitation: MeasurementObserver | None = None,
        line_interval_s: float = 10.0,
    ) -> None:
        super().__init__()
        self._stop = stop
        self._metrics = metrics
        self._imitation = imitation
        self._line_interval_s = line_interval_s
        self._bar: tqdm | None = None
        self._unwritten_epoch: int | None = None
        self._total = 0

    def after_init(self, algo: Any) -> None:
        """Store the agent and start the clock."""
        self._algo = algo
        self._start_s = self._last_line_s = self._last_epoch_s = time.monotonic()
        self._first_line = True
        self._first_epoch: int | None = None
        self._has_estimated = False
        self._frames_per_s = AverageMeter(1, 10)

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Show the progress; end the training if the user requested it."""
        algo = self._algo
        self._total = algo.max_epochs  # a stop request changes max_epochs below
        now = time.monotonic()
        fps = algo.curr_frames * current_group().size / max(now - self._last_epoch_s, 1e-9)
        self._frames_per_s.update(torch.tensor([fps]))
        self._last_epoch_s = now
        if self._first_epoch is None:
            self._first_epoch = epoch_num
        if not self._has_estimated and now - self._start_s >= _ESTIMATE_AFTER_S:
            self._has_estimated = True
            if (left := self._left_s(epoch_num, now)) is not None:
                minutes = f"{left / 60:.0f} minutes" if left >= 120 else f"{left:.0f} seconds"
                log.info(
                    "%d more epochs take about %s on this machine, at %s frames/s; Ctrl-C ends the"
                    " training with a checkpoint",
                    *(self._total - epoch_num, minutes, self._fps()),
                )
        if sys.stderr.isatty():
            if self._bar is None:
                total = algo.max_epochs if algo.max_epochs > 0 else None
                first = epoch_num - 1
                self._bar = tqdm(
                    total=total, initial=first, dynamic_ncols=True, bar_format=_BAR_FORMAT
                )
            # tqdm cuts its text at the width of the terminal, so the least important value comes
            # last.
            shown = {**self._measured_values(), **self._epoch_values(), "fps": self._fps()}
            self._bar.set_postfix(shown, refresh=False)
            self._bar.update(epoch_num - self._bar.n)
            self._first_line = False
        elif self._first_line or now - self._last_line_s >= self._line_interval_s:
            self._write_line(epoch_num, now)
        else:
            self._unwritten_epoch = epoch_num
        if self._stop.requested:
            # rl_games saves a last checkpoint when it ends at max_epochs.
            algo.max_epochs = epoch_num

    def _left_s(self, epoch_num: int, now: float) -> float | None:
        """Return the time in s for the remaining epochs, or None if the epochs are unlimited."""
        if self._total <= epoch_num:
            return None
        made = epoch_num - (self._first_epoch or epoch_num) + 1
        return (self._total - epoch_num) * (now - self._start_s) / made

    def _epoch_values(self) -> dict[str, str]:
        """Return the epoch's metrics as texts; unknown metrics are left out."""
        metrics, shown = self._metrics.latest, dict[str, str]()
        if metrics is None:
            return shown
        if metrics.episode_steps is not None:
            shown["episode length"] = f"{metrics.episode_steps:.0f}"
        if metrics.fall_rate is not None:
            shown["falls"] = f"{metrics.fall_rate:.0%}"
        if metrics.off_clip_rate is not None:
            shown["off the clip"] = f"{metrics.off_clip_rate:.0%}"
        for name, mean in metrics.successes.items():
            shown[name.replace("_", " ")] = f"{mean:.2f}"
        # The task's reward is left out if the agent does not learn from it.
        if metrics.episode_reward is not None and self._algo.config.get("task_reward_w", 1.0) != 0:
            shown["reward"] = f"{metrics.episode_reward:.2f}"
        if metrics.style_reward is not None:
            shown["style reward"] = f"{metrics.style_reward:.2f}"
        if metrics.disc_accuracy is not None:
            shown["disc accuracy"] = f"{metrics.disc_accuracy:.0%}"
        return shown

    def _measured_values(self) -> dict[str, str]:
        """Return the newest measurement as texts; empty before the first measurement."""
        result = self._imitation.last if self._imitation is not None else None
        if result is None:
            return {}
        if result.imitation is None:
            successes = result.successes.items()
            return {
                "measured reward": f"{result.reward:.2f}",
                "measured falls": f"{result.falls:.0%}",
                **{f"measured {n.replace('_', ' ')}": f"{mean:.2f}" for n, mean in successes},
            }
        measured = result.imitation
        return {
            "pose error": f"{measured.pose_error_m:.3f} m",
            "tempo": f"{measured.tempo:.2f}",
            "motion shown": f"{measured.motion_shown:.0%}",
            **{name: f"{error:.2f}" for name, error in result.goal_errors.items()},
        }

    def _fps(self) -> str:
        return f"{self._frames_per_s.mean.item():,.0f}"

    def _write_line(self, epoch_num: int, now: float, has_ended: bool = False) -> None:
        self._first_line = False
        self._unwritten_epoch = None
        self._last_line_s = now
        total = self._total
        parts = [f"epoch {epoch_num}/{total}" if total > 0 else f"epoch {epoch_num}"]
        if total > 0 and not has_ended:
            minutes, seconds = divmod(int(self._left_s(epoch_num, now) or 0.0), 60)
            parts.append(f"ETA {minutes // 60}:{minutes % 60:02d}:{seconds:02d}")
        shown = {"fps": self._fps(), **self._epoch_values(), **self._measured_values()}
        parts += [f"{name} {value}" for name, value in shown.items()]
        log.info("%s", ", ".join(parts))

    def close(self) -> None:
        """Close the progress bar; write the last epoch's values unless they were written."""
        if self._bar is not None:
            self._bar.close()
        if self._unwritten_epoch is not None:
            self._write_line(self._unwritten_epoch, self._last_epoch_s, has_ended=True)
