"""Broken and hostile files: readers survive them, and the benchmark notices when they do not."""

from __future__ import annotations

import mmap
import os
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from benchmarks.fuzz import __main__ as command
from benchmarks.fuzz import clips, robots
from benchmarks.fuzz.campaign import Plan, run
from benchmarks.fuzz.examine import Examiner, Limits, Verdict
from benchmarks.fuzz.kinds import Kind
from isaacgymenvs_lite.errors import UserError

SEED = 19
MUTATIONS = 30
# The long ones take seconds; the benchmark itself reads them.
LONGEST = 2**17
LIMITS = Limits(memory_bytes=2**27)


@pytest.mark.parametrize("kind", (*clips.KINDS, *robots.KINDS), ids=lambda kind: kind.name)
def test_every_broken_file_of_a_clip_or_a_robot_is_accepted_or_refused_in_one_line(
    kind: Kind, tmp_path: Path
) -> None:
    if kind.suffix == ".bvh":
        pytest.importorskip("pybvh")
    examiner = Examiner(kind, tmp_path / kind.name, SEED, LIMITS)
    numbers = range(examiner.num_hostile + MUTATIONS)
    outcomes = [examiner.load(n) for n in numbers if len(examiner.content(n)) <= LONGEST]
    defects = [(examiner.name(o.number), o) for o in outcomes if o.is_defect]
    assert not defects
    assert {outcome.verdict for outcome in outcomes} == {Verdict.ACCEPTED, Verdict.REFUSED}


def _original(folder: Path) -> list[Path]:
    (folder / "original.txt").write_text("fine")
    return [folder / "original.txt"]


def _kind(read: Callable[[Path], object]) -> Kind:
    """Return a kind of files of which only the original is read well."""
    return Kind("made_up", ".txt", _original, lambda p: p.stem == "original" or read(p))


def _raises(error: BaseException) -> Callable[[Path], object]:
    def read(_path: Path) -> object:
        raise error

    return read


def _refuses(message: str) -> Callable[[Path], object]:
    return _raises(UserError(message))


def _spins(_path: Path) -> None:
    while True:
        pass


def _writes(path: Path, name: str) -> None:
    path.with_name(name).write_text("x")


def _takes(num_bytes: int) -> None:
    """Take memory from the system: malloc has some of earlier tests, which does not count."""
    with mmap.mmap(-1, num_bytes) as memory:
        memory[:: mmap.PAGESIZE] = bytes(num_bytes // mmap.PAGESIZE)


@pytest.mark.parametrize(
    ("read", "verdict"),
    [
        (lambda path: path.read_bytes(), Verdict.ACCEPTED),
        (_refuses("input.txt: is no clip"), Verdict.REFUSED),
        (_refuses("is no clip"), Verdict.OTHER),
        (_raises(ValueError("input.txt: is no clip")), Verdict.OTHER),
        (_raises(MemoryError()), Verdict.OTHER),
        (lambda path: warnings.warn("overflow", RuntimeWarning, stacklevel=2), Verdict.OTHER),
        (lambda path: _writes(path, "other.txt"), Verdict.OTHER),
        (lambda path: _writes(path, "canary"), Verdict.CODE),
        (lambda path: _takes(2**27), Verdict.MEMORY),
        (_spins, Verdict.HANG),
    ],
)
def test_what_a_reader_does_wrong_is_noticed(read, verdict: Verdict, tmp_path: Path) -> None:
    limits = Limits(time_s=0.2, memory_bytes=2**25)
    examiner = Examiner(_kind(read), tmp_path / "files", SEED, limits)
    assert examiner.load(0).verdict is verdict


class _LongError(UserError):
    """An error that does not keep to the limits of the project's."""

    def __str__(self) -> str:
        return "input.txt: " + "x" * 2000


class _TwoLinesError(UserError):
    """An error that a file can use to write to a terminal."""

    def __str__(self) -> str:
        return "input.txt: a\nb"


@pytest.mark.parametrize("error", [_LongError(), _TwoLinesError()])
def test_errors_that_are_no_short_line_are_noticed(error: UserError, tmp_path: Path) -> None:
    examiner = Examiner(_kind(_raises(error)), tmp_path / "files", SEED, Limits())
    assert examiner.load(0).verdict is Verdict.OTHER


def test_a_reader_that_ends_or_stops_its_process_is_noticed(tmp_path: Path) -> None:
    def read(path: Path) -> None:
        marks.append(path)
        if len(marks) == 2:
            os._exit(1)

    marks: list[Path] = []
    tally = run(Plan(_kind(read), tmp_path / "files", first=0, count=4, seed=SEED))
    # Each new process reads one file before it ends.
    assert tally.counts == {Verdict.ACCEPTED: 2, Verdict.OTHER: 2}
    assert [defect.number for defect in tally.defects] == [1, 3]

    limits = Limits(time_s=0.05)
    sleeping = _kind(lambda path: time.sleep(60.0))
    tally = run(Plan(sleeping, tmp_path / "more", first=5, count=2, seed=SEED, limits=limits))
    assert [(d.number, d.verdict) for d in tally.defects] == [(5, Verdict.HANG), (6, Verdict.HANG)]


@pytest.fixture
def same_threads() -> Iterator[None]:
    """Keep the number of threads that the command sets from the other tests."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("same_threads")
def test_the_command_prints_a_table_and_keeps_what_is_wrong(tmp_path: Path, capsys, monkeypatch):
    kinds = {"bad": _kind(_raises(KeyError("x"))), "good": _kind(_refuses("input.txt: no"))}
    monkeypatch.setattr(command, "all_kinds", lambda: kinds)
    words = ["--inputs", "3", "--keep", str(tmp_path), "--kinds"]
    assert command.main([*words, "good"]) == 0
    assert command.main([*words, "bad"]) == 1
    shown = capsys.readouterr()
    assert shown.out.splitlines()[-1].split()[:5] == ["all", "3", "0", "0", "3"]
    assert "--kinds made_up --seed 0 --only 2" in shown.err
    assert len(list((tmp_path / "made_up").iterdir())) == 3
