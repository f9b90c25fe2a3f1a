"""How far a training is: a progress bar or lines, and the stop at Ctrl-C."""

from __future__ import annotations

import logging
import sys
import time
from typing import Any

import torch
from rl_games.algos_torch.torch_ext import AverageMeter
from rl_games.common.algo_observer import AlgoObserver
from tqdm import tqdm

from isaacgymenvs_lite.run.imitation import ImitationObserver
from isaacgymenvs_lite.run.metrics import MetricsObserver
from isaacgymenvs_lite.run.stop_request import StopRequest

log = logging.getLogger(__name__)

# tqdm's own without elapsed time and rate, whose room the figures need.
_BAR_FORMAT = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{remaining}{postfix}]"


class ProgressObserver(AlgoObserver):
    """A progress bar on a terminal, a line every few seconds elsewhere; and the stop at Ctrl-C.

    Elsewhere the first and the last epoch have their lines, however short the training is.

    Args:
        stop: asked for by the user; the epoch that hears of it is made the last one.
        figures: what is shown; stands before this observer.
        imitation: whose newest pose error and tempo are shown, if any.
        line_interval_s: seconds between lines where the output is no terminal.
    """

    def __init__(
        self,
        stop: StopRequest,
        figures: MetricsObserver,
        imitation: ImitationObserver | None = None,
        line_interval_s: float = 10.0,
    ) -> None:
        super().__init__()
        self._stop = stop
        self._figures = figures
        self._imitation = imitation
        self._line_interval_s = line_interval_s
        self._bar: tqdm | None = None
        self._unwritten_epoch: int | None = None
        self._total = 0

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
        self._total = algo.max_epochs  # before a stop makes this epoch the last one
        now = time.monotonic()
        fps = algo.curr_frames / max(now - self._last_epoch_s, 1e-9)
        self._frames_per_s.update(torch.tensor([fps]))
        self._last_epoch_s = now
        if self._first_epoch is None:
            self._first_epoch = epoch_num
        if sys.stderr.isatty():
            self._update_bar(epoch_num)
        elif self._first_line or now - self._last_line_s >= self._line_interval_s:
            self._write_line(epoch_num, now)
        else:
            self._unwritten_epoch = epoch_num
        if self._stop.requested:
            # rl_games ends at max_epochs by saving a last checkpoint: just what is wanted.
            algo.max_epochs = epoch_num

    def _epoch_values(self) -> dict[str, str]:
        """Return the epoch's figures as texts, as far as they are known."""
        figures, shown = self._figures.latest, {}
        if figures is None:
            return shown
        if figures.episode_steps is not None:
            shown["episode length"] = f"{figures.episode_steps:.0f}"
        if figures.fall_rate is not None:
            shown["falls"] = f"{figures.fall_rate:.0%}"
        # A task's reward that the agent does not learn from would only take room.
        if figures.episode_reward is not None and self._algo.config.get("task_reward_w", 1.0) != 0:
            shown["reward"] = f"{figures.episode_reward:.2f}"
        if figures.style_reward is not None:
            shown["style reward"] = f"{figures.style_reward:.2f}"
        if figures.disc_accuracy is not None:
            shown["disc accuracy"] = f"{figures.disc_accuracy:.0%}"
        return shown

    def _measured_values(self) -> dict[str, str]:
        """Return the newest measurement as texts, if there is one."""
        result = self._imitation.last if self._imitation is not None else None
        if result is None or result.imitation is None:
            return {}
        measured = result.imitation
        return {
            "pose error": f"{measured.pose_error_m:.3f} m",
            "tempo": f"{measured.tempo:.2f}",
        }

    def _fps(self) -> str:
        return f"{self._frames_per_s.mean.item():,.0f}"

    def _update_bar(self, epoch_num: int) -> None:
        if self._bar is None:
            total = self._algo.max_epochs if self._algo.max_epochs > 0 else None
            first = epoch_num - 1
            self._bar = tqdm(total=total, initial=first, dynamic_ncols=True, bar_format=_BAR_FORMAT)
        # tqdm cuts off what the terminal has no room for: the least important comes last.
        shown = {**self._measured_values(), **self._epoch_values(), "fps": self._fps()}
        self._bar.set_postfix(shown, refresh=False)
        self._bar.update(epoch_num - self._bar.n)

    def _write_line(self, epoch_num: int, now: float, has_ended: bool = False) -> None:
        self._first_line = False
        self._unwritten_epoch = None
        self._last_line_s = now
        total = self._total
        parts = [f"epoch {epoch_num}/{total}" if total > 0 else f"epoch {epoch_num}"]
        if total > 0 and not has_ended:
            made = epoch_num - (self._first_epoch or epoch_num) + 1
            left_s = (total - epoch_num) * (now - self._start_s) / made
            parts.append(f"ETA {_clock(left_s)}")
        shown = {"fps": self._fps(), **self._epoch_values(), **self._measured_values()}
        parts += [f"{name} {value}" for name, value in shown.items()]
        log.info("%s", ", ".join(parts))

    def close(self) -> None:
        """Leave the terminal in order; write a line of the last epoch if there is none yet."""
        if self._bar is not None:
            self._bar.close()
        if self._unwritten_epoch is not None:
            self._write_line(self._unwritten_epoch, self._last_epoch_s, has_ended=True)


def _clock(seconds: float) -> str:
    minutes, secs = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{secs:02d}"
