"""Writes event files of invented trainings with the project's writer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from tensorboardX import SummaryWriter

from isaacgymenvs_lite.run import event_writer
from isaacgymenvs_lite.run.event_writer import install

FRAMES_PER_EPOCH = 100
EPOCH_S = 60.0

WriteEvents = Callable[..., None]


class Clock:
    """A clock for the writer, which only the test advances."""

    def __init__(self, now_s: float) -> None:
        self.now_s = now_s

    def monotonic(self) -> float:
        return self.now_s

    def time(self) -> float:
        return self.now_s

    def time_ns(self) -> int:
        return int(self.now_s * 1e9)


@pytest.fixture
def write_events(monkeypatch: pytest.MonkeyPatch) -> WriteEvents:
    """Return write(summaries, lengths, first_epoch=0, start_s=1000.0, poses={})."""

    def write(
        summaries: Path,
        lengths: Sequence[float | None],
        first_epoch: int = 0,
        start_s: float = 1000.0,
        poses: dict[int, float] | None = None,
    ) -> None:
        clock = Clock(start_s)
        monkeypatch.setattr(event_writer, "time", clock)
        writer: Any = SummaryWriter(str(summaries))
        install(writer)
        for epoch, length in enumerate(lengths, start=first_epoch):
            clock.now_s += EPOCH_S
            frame = epoch * FRAMES_PER_EPOCH  # rl_games: the frames before the epoch
            writer.add_scalar("performance/total_fps", 1.5, frame, walltime=clock.now_s)
            writer.add_scalar("info/disc_reward_mean", 0.5, frame, walltime=clock.now_s)
            if length is not None:
                writer.add_scalar("episode_lengths/frame", length, frame, walltime=clock.now_s)
                writer.add_scalar("rewards/step", 10 * length, frame, walltime=clock.now_s)
            if poses and epoch in poses:
                value = poses[epoch]
                writer.add_scalar("imitation/pose_error_m", value, frame, walltime=clock.now_s)
        writer.close()

    return write
