from __future__ import annotations

import errno
import logging
import os
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboardX import SummaryWriter

from isaacgymenvs_lite.run import event_writer
from isaacgymenvs_lite.run.event_writer import install


@pytest.fixture
def clock(monkeypatch) -> Any:
    """Seconds that pass only when a test adds them."""

    class Clock:
        now_s = 1000.0

        def monotonic(self) -> float:
            return self.now_s

        def time(self) -> float:
            return 1.7e9 + self.now_s

        def time_ns(self) -> int:
            return int(self.time() * 1e9)

    fake = Clock()
    monkeypatch.setattr(event_writer, "time", fake)
    return fake


@pytest.fixture
def writer(tmp_path) -> Any:
    writer = SummaryWriter(str(tmp_path / "summaries"))
    install(writer)
    yield writer
    writer.close()


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard itself reads from a folder."""
    accumulator = EventAccumulator(str(folder), {"scalars": 0})
    accumulator.Reload()
    return {
        tag: [(event.step, event.value) for event in accumulator.Scalars(tag)]
        for tag in accumulator.Tags()["scalars"]
    }


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("events.out.tfevents.*"))


def test_tensorboard_reads_what_was_written(writer, tmp_path):
    for step in range(30):
        writer.add_scalar("losses/a_loss", 0.5 * step, step)
    writer.add_scalar("info/kl", -1.0, 7)
    writer.close()
    assert scalars(tmp_path / "summaries") == {
        "losses/a_loss": [(step, 0.5 * step) for step in range(30)],
        "info/kl": [(7, -1.0)],
    }
    assert len(files(tmp_path / "summaries")) == 1


def test_events_reach_the_file_within_ten_seconds(clock, tmp_path):
    writer = SummaryWriter(str(tmp_path))
    install(writer)
    writer.add_scalar("x", 1.0, 0)  # the first one goes at once
    assert scalars(tmp_path) == {"x": [(0, 1.0)]}
    clock.now_s += 5.0
    writer.add_scalar("x", 2.0, 1)
    assert scalars(tmp_path) == {"x": [(0, 1.0)]}
    clock.now_s += 5.1
    writer.add_scalar("x", 3.0, 2)
    assert scalars(tmp_path) == {"x": [(0, 1.0), (1, 2.0), (2, 3.0)]}
    writer.add_scalar("x", 4.0, 3)
    writer.close()
    assert scalars(tmp_path)["x"][-1] == (3, 4.0)


class FullDisk:
    """Stands in for os.write: takes `room` bytes, then none, until `room` grows."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._write = os.write

    def __call__(self, fd: int, data: bytes) -> int:
        if self.room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = self._write(fd, data[: self.room])
        self.room -= taken
        return taken


def test_a_full_disk_stops_nothing_and_loses_nothing(clock, tmp_path, monkeypatch, caplog):
    writer = SummaryWriter(str(tmp_path))
    install(writer)
    writer.add_scalar("x", 0.0, 0)
    disk = FullDisk(room=100)
    monkeypatch.setattr(event_writer.os, "write", disk)
    for step in range(1, 50):
        clock.now_s += 11.0
        writer.add_scalar("x", float(step), step)
    # half a record would end the file for every reader
    assert scalars(tmp_path)["x"][0] == (0, 0.0)
    warnings = [r for r in caplog.records if r.levelno == logging.WARNING]
    assert len(warnings) == 1
    assert "No space left" in warnings[0].getMessage()

    disk.room = 10**9
    clock.now_s += 11.0
    writer.add_scalar("x", 50.0, 50)
    assert scalars(tmp_path)["x"] == [(step, float(step)) for step in range(51)]
    assert "again" in caplog.records[-1].getMessage()
    writer.close()


def test_a_folder_that_vanished_is_made_again(clock, tmp_path):
    folder = tmp_path / "summaries"
    writer = SummaryWriter(str(folder))
    install(writer)
    writer.add_scalar("x", 1.0, 1)
    for file in files(folder):
        file.unlink()
    folder.rmdir()
    clock.now_s += 11.0
    writer.add_scalar("x", 2.0, 2)
    writer.close()
    assert scalars(folder) == {"x": [(2, 2.0)]}
