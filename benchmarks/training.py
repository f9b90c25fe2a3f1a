"""Runs train.py in processes that are pinned to CPUs and end by the clock.

With `multi_gpu=True` torchrun starts one process for each of the CPUs.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

from benchmarks.experiments import Experiment, override
from benchmarks.learning_curve import LearningCurve, read_learning_curve
from benchmarks.runs import ROOT, Run, start_now
from isaacgymenvs_lite.errors import ConfigError

_POLL_S = 0.5
_LOOK_S = 20.0  # at the learning curve, which takes a part of a second
# A run that was asked to end finishes its epoch and writes a checkpoint; then it is asked again,
# which ends it at once.
_PATIENCE_S = 120.0
# Less time left than this is not worth a start, which itself takes several seconds.
_SHORTEST_MIN = 0.5
_RANKS = "multi_gpu=True"


@dataclass(frozen=True)
class Plan:
    """What is to be run: made before anything starts, so that mistakes show at once.

    Attributes:
        run: whose folder it writes.
        settings: the experiment's overrides.
        checkpoint: where it goes on, None for a new run.
        minutes: how long, at most; 0 if the run has had its time.
        is_over: whether a run with this curve may end before.
    """

    run: Run
    settings: tuple[str, ...]
    checkpoint: Path | None
    minutes: float
    is_over: Callable[[LearningCurve], bool] = lambda curve: False

    def command(self, cores: Sequence[int]) -> list[str]:
        """Return the command line of train.py for so many CPUs."""
        run_dir = self.run.folder.absolute()
        threads = 1 if self.has_ranks else len(cores)
        words = [f"num_threads={threads}", f"++train.params.torch_threads={threads}"]
        train = [sys.executable, str(ROOT / "train.py")]
        if self.has_ranks:
            torchrun = ("-m", "torch.distributed.run", "--standalone")
            train[1:1] = [*torchrun, f"--nproc-per-node={len(cores)}"]
        if self.checkpoint is not None:
            together = (_RANKS,) if self.has_ranks else ()
            return [*train, override("resume", str(run_dir)), *together, *words]
        own = [
            f"seed={self.run.seed}",
            override("+full_experiment_name", run_dir.name),
            override("+train.params.config.train_dir", str(run_dir.parent)),
        ]
        return [*train, *self.settings, *own, *words]

    @property
    def has_ranks(self) -> bool:
        """Whether several processes train together."""
        return _RANKS in self.settings


def plan(experiment: Experiment, run: Run, minutes: float, resume: bool) -> Plan:
    """Decide where a run begins and how long it may take.

    Args:
        experiment: what is trained.
        run: where.
        minutes: of training, earlier parts of a resumed run included; a start that would be left
            with less than half a minute is not made: to start takes most of it.
        resume: go on from the newest checkpoint if there is one.

    Raises:
        ConfigError: the run exists and is not to be resumed, or was made with other settings.
    """
    checkpoint = run.newest_checkpoint()
    if checkpoint is None:
        return Plan(run, experiment.settings, None, minutes)
    if not resume:
        raise ConfigError(
            f"{run.folder} holds a training already; --resume goes on with it, --runs-dir FOLDER"
            " begins another"
        )
    starts = run.starts()
    # The last one: starts before it may have failed without a checkpoint.
    before = starts[-1].settings if starts else []
    if starts and sorted(before) != sorted(experiment.settings):
        changed = " ".join(sorted(set(before) ^ set(experiment.settings)))
        raise ConfigError(
            f"{run.folder} was trained with other settings, different: {changed}; give the same"
            " ones, or --runs-dir FOLDER to begin another training"
        )
    trained_min = read_learning_curve(run.folder / "summaries").minutes
    left_min = minutes - trained_min
    if left_min < _SHORTEST_MIN:
        left_min = 0.0
    return Plan(run, experiment.settings, checkpoint, left_min)


class Process(Protocol):
    """What `train_all` asks of a running training."""

    run: Run

    def poll(self, stop: bool) -> int | None:
        """Return the exit code, None while it runs; end it when its time is over, or at `stop`."""
        ...

    def close(self) -> None:
        """End it now, with a checkpoint, and wait for that; nothing if it has ended."""
        ...


class Training:
    """One train.py process.

    Args:
        job: what it runs.
        cores: CPUs that it is pinned to.
        command: the command line, by default the plan's own.
        clock_s: returns the time in s.
    """

    def __init__(
        self,
        job: Plan,
        cores: Sequence[int],
        command: Sequence[str] | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.run = job.run
        self._is_over = job.is_over
        self._has_ranks = job.has_ranks
        self._clock_s = clock_s
        self._limit_s = 60.0 * job.minutes
        words = list(command or job.command(cores))
        self.run.note_start(start_now(job.settings, shlex.join(words), cores))
        with log_file(self.run).open("a", encoding="utf-8") as log:
            self.process = _start(words, cores, log)
        self._start_s = clock_s()
        self._look_again_s = self._start_s + _LOOK_S
        self._ask_again_s = 0.0

    def poll(self, stop: bool) -> int | None:
        """Return the exit code, None while it runs; end it when it is over, or at `stop`."""
        code = self.process.poll()
        now_s = self._clock_s()
        if code is None and now_s >= self._look_again_s:
            self._look_again_s = now_s + _LOOK_S
            if self._is_over(read_learning_curve(self.run.folder / "summaries")):
                self._limit_s = 0.0
        if code is None and (stop or now_s - self._start_s >= self._limit_s):
            self._ask_to_end(now_s)
        return code

    def close(self) -> None:
        """End it now, with a checkpoint, and wait for that; nothing if it has ended."""
        if self.process.poll() is None:
            self._interrupt()
            self.process.wait()

    def _ask_to_end(self, now_s: float) -> None:
        if now_s >= self._ask_again_s:
            self._interrupt()
            self._ask_again_s = now_s + _PATIENCE_S

    def _interrupt(self) -> None:
        """Send Ctrl-C to train.py; not to torchrun, which would end as a failure."""
        if not self._has_ranks:
            self.process.send_signal(signal.SIGINT)
            return
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        for pid in children.read_text(encoding="ascii").split()[:1]:  # one rank ends all
            os.kill(int(pid), signal.SIGINT)


def log_file(run: Run) -> Path:
    """Return the file that gets what train.py says."""
    return run.folder / "train.log"


def _start(words: Sequence[str], cores: Sequence[int], log: IO[str]) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "OMP_NUM_THREADS": str(len(cores))}
    process = subprocess.Popen(
        words,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # Ctrl-C reaches it through `poll` only, and once
    )
    # Before it has threads, which inherit the CPUs.
    os.sched_setaffinity(process.pid, cores)
    return process


def train_all(
    plans: Sequence[Plan],
    slots: Sequence[Sequence[int]],
    is_stopped: Callable[[], bool],
    start: Callable[[Plan, Sequence[int]], Process] = Training,
    say: Callable[[str], None] = print,
    on_end: Callable[[Run], None] = lambda run: None,
) -> list[Run]:
    """Run all plans, as many at a time as there are slots; return the runs that failed.

    Args:
        plans: in the order in which they start.
        slots: the CPUs of each place.
        is_stopped: whether all should end now, with checkpoints; nothing is started then.
        start: starts a training on CPUs.
        say: shows a line to the user.
        on_end: called with each run that ended well, unless all end now.
    """
    waiting, failed = list(plans), []
    active: dict[int, Process] = {}
    try:
        while waiting or active:
            for slot, cores in enumerate(slots):
                if slot not in active and waiting and not is_stopped():
                    job = waiting.pop(0)
                    active[slot] = start(job, cores)
                    say(f"{job.run.label}: {job.minutes:.1f} min on CPUs {list(cores)}")
            for slot, process in list(active.items()):
                code = process.poll(is_stopped())
                if code is None:
                    continue
                del active[slot]
                say(f"{process.run.label}: ended with exit code {code}")
                if code != 0:
                    failed.append(process.run)
                elif not is_stopped():
                    on_end(process.run)
            if is_stopped():
                waiting.clear()
            if active:
                time.sleep(_POLL_S)
    finally:
        for process in active.values():
            process.close()
    return failed
