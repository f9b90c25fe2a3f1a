"""Has thousands of broken files of a kind read in a process of its own, and counts.

The process reads one file after another. It is replaced if it dies or does not answer.
"""

from __future__ import annotations

import logging
import multiprocessing
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from benchmarks.fuzz.examine import Examiner, Limits, Outcome, Verdict, limit_address_space
from benchmarks.fuzz.kinds import Kind

# Seconds on the clock for each second of the processor: other processes use it as well.
_CLOCK_FACTOR = 24.0
_START_S = 600.0
_fork = multiprocessing.get_context("fork")


@dataclass
class Tally:
    """What became of the files of one kind.

    Attributes:
        kind: name of the kind.
        counts: files by verdict.
        defects: outcomes that are neither accepted nor refused.
        slowest_s: the longest time of a file.
        largest_bytes: the most by which a process grew.
    """

    kind: str
    counts: Counter[Verdict] = field(default_factory=Counter)
    defects: list[Outcome] = field(default_factory=list)
    slowest_s: float = 0.0
    largest_bytes: int = 0

    def add(self, *outcomes: Outcome) -> None:
        """Count files."""
        for outcome in outcomes:
            self.counts[outcome.verdict] += 1
            self.slowest_s = max(self.slowest_s, outcome.time_s)
            self.largest_bytes = max(self.largest_bytes, outcome.memory_bytes)
            if outcome.is_defect:
                self.defects.append(outcome)


@dataclass(frozen=True)
class Plan:
    """Which files of a kind are read, and how.

    Attributes:
        kind: of files.
        folder: for them; it is filled.
        first: number of the first file.
        count: of the files.
        seed: of the changes.
        limits: of each file.
        command_every: every file whose number is a multiple is also read by the kind's command;
            0: none.
    """

    kind: Kind
    folder: Path
    first: int
    count: int
    seed: int = 0
    limits: Limits = field(default_factory=Limits)
    command_every: int = 0

    @property
    def numbers(self) -> range:
        """The numbers of the files."""
        return range(self.first, self.first + self.count)

    def read(self, examiner: Examiner, number: int) -> list[Outcome]:
        """Read one file, and by the command if it is its turn."""
        outcomes = [examiner.load(number)]
        if self.command_every and self.kind.command and number % self.command_every == 0:
            outcomes.append(examiner.command(number))
        return outcomes


def run(plan: Plan) -> Tally:
    """Read the files of a plan in a process of their own.

    Raises:
        RuntimeError: the process cannot begin: a valid file is refused.
    """
    tally = Tally(plan.kind.name)
    left = plan.numbers
    while left:
        ours, theirs = _fork.Pipe(duplex=False)
        process = _fork.Process(target=_work, args=(plan, left, theirs), daemon=True)
        process.start()
        theirs.close()
        left = _collect(plan, tally, ours, left)
        process.kill()
        process.join()
        ours.close()
    return tally


def run_here(plan: Plan) -> Tally:
    """Read the files of a plan in this process; a reader that never returns to Python stays."""
    tally = Tally(plan.kind.name)
    examiner = Examiner(plan.kind, plan.folder, plan.seed, plan.limits)
    for number in plan.numbers:
        tally.add(*plan.read(examiner, number))
    return tally


def run_processes(plan: Plan) -> Tally:
    """Have the files of a plan read by the kind's command, each in a process of its own."""
    tally = Tally(f"{plan.kind.name}, processes")
    examiner = Examiner(plan.kind, plan.folder, plan.seed, plan.limits)
    assert plan.kind.command is not None
    for number in range(plan.first, plan.first + plan.count):
        examiner.file.write_bytes(examiner.content(number))
        words = [sys.executable, "-m", *plan.kind.command(examiner.file)]
        clock_s = _CLOCK_FACTOR * plan.limits.time_s
        try:
            done = subprocess.run(words, capture_output=True, timeout=clock_s, check=False)
        except subprocess.TimeoutExpired:
            tally.add(Outcome(number, Verdict.HANG, f"no answer within {clock_s:g} s"))
            continue
        stderr = done.stderr.decode("utf-8", "replace")
        tally.add(Outcome(number, *examiner.judge_command(done.returncode, stderr)))
    return tally


def _work(plan: Plan, numbers: range, answers: Connection) -> None:
    """Read files; send an empty list before the first and the outcomes of each."""
    torch.set_num_threads(1)
    logging.disable()
    examiner = Examiner(plan.kind, plan.folder, plan.seed, plan.limits)
    limit_address_space(plan.limits)
    answers.send([])
    for number in numbers:
        answers.send(plan.read(examiner, number))


def _collect(plan: Plan, tally: Tally, answers: Connection, numbers: range) -> range:
    """Count what a process sends until it ends or does not answer; returns the numbers left."""
    clock_s = _CLOCK_FACTOR * plan.limits.time_s
    began = False
    while numbers or not began:
        try:
            if not answers.poll(clock_s if began else _START_S):
                verdict, problem = Verdict.HANG, f"no answer within {clock_s:g} s"
                break
            outcomes = answers.recv()
        except EOFError:
            verdict, problem = Verdict.OTHER, "the process died"
            break
        tally.add(*outcomes)
        numbers = numbers[bool(outcomes) :]
        began = True
    else:
        return numbers
    if not began:
        raise RuntimeError(f"{plan.kind.name}: the process did not begin; its traceback is above")
    tally.add(Outcome(numbers[0], verdict, problem))
    return numbers[1:]
