"""Runs train.py in processes that are pinned to CPUs and end after a given time.

With `multi_gpu=True` torchrun starts one process for each CPU.
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
from typing import Any

from benchmarks.experiments import Experiment, override
from benchmarks.learning_curve import LearningCurve, read_learning_curve
from benchmarks.runs import ROOT, Run, start_now
from isaacgymenvs_lite.errors import ConfigError

_POLL_S = 0.5
_LOOK_S = 20.0  # reading the learning curve takes a part of a second
# After the first SIGINT a run finishes its epoch and writes a checkpoint. If it still runs after
# this time, a second SIGINT ends it at once.
_PATIENCE_S = 120.0
_SHORTEST_MIN = 0.5  # a start alone takes several seconds
_RANKS = "multi_gpu=True"


@dataclass(frozen=True)
class Plan:
    """One process to start; all plans exist before the first start, which reveals mistakes early.

    Attributes:
        run: the run with its folder.
        settings: the experiment's overrides.
        checkpoint: checkpoint of a resumed run, None for a new run.
        minutes: time limit; 0 if the run has used its time.
        is_over: returns whether a run with this learning curve may end early.
    """

    run: Run
    settings: tuple[str, ...]
    checkpoint: Path | None
    minutes: float
    is_over: Callable[[LearningCurve], bool] = lambda curve: False

    def command(self, cores: Sequence[int]) -> list[str]:
        """Return the command line of train.py for these CPUs."""
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
        """True if several processes train together."""
        return _RANKS in self.settings


def plan(experiment: Experiment, run: Run, minutes: float, resume: bool) -> Plan:
    """Return the plan of a run.

    Args:
        experiment: the experiment.
        run: the run with its folder.
        minutes: time limit, which includes the earlier parts of a resumed run. If less than half a
            minute is left, the plan has 0 minutes.
        resume: continue from the newest checkpoint if there is one.

    Raises:
        ConfigError: the run exists and `resume` is false, or it was trained with other settings.
    """
    checkpoint = run.newest_checkpoint()
    if checkpoint is None:
        return Plan(run, experiment.settings, None, minutes)
    if not resume:
        raise ConfigError(
            f"{run.folder} holds a training already; --resume continues it, --runs-dir FOLDER"
            " starts another training"
        )
    starts = run.starts()
    # Earlier starts may have failed without a checkpoint.
    before = starts[-1].settings if starts else []
    if starts and sorted(before) != sorted(experiment.settings):
        changed = " ".join(sorted(set(before) ^ set(experiment.settings)))
        raise ConfigError(
            f"{run.folder} was trained with other settings, different: {changed}; give the same"
            " settings, or --runs-dir FOLDER for another training"
        )
    left_min = minutes - read_learning_curve(run.folder / "summaries").minutes
    if left_min < _SHORTEST_MIN:
        left_min = 0.0
    return Plan(run, experiment.settings, checkpoint, left_min)


class Training:
    """One train.py process.

    Args:
        job: the plan.
        cores: CPUs of the process.
        command: command line in place of the plan's command line.
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
            self.process = subprocess.Popen(
                words,
                env={**os.environ, "OMP_NUM_THREADS": str(len(cores))},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # otherwise Ctrl-C would reach it a second time
            )
        # The threads that train.py starts later inherit the CPUs.
        os.sched_setaffinity(self.process.pid, cores)
        self._start_s = clock_s()
        self._look_again_s = self._start_s + _LOOK_S
        self._ask_again_s = 0.0

    def poll(self, stop: bool) -> int | None:
        """Return the exit code, or None while the process runs.

        The process is asked to end if its time is over, if it may end early, or if `stop` is true.
        """
        code = self.process.poll()
        now_s = self._clock_s()
        if code is None and now_s >= self._look_again_s:
            self._look_again_s = now_s + _LOOK_S
            if self._is_over(read_learning_curve(self.run.folder / "summaries")):
                self._limit_s = 0.0
        is_over = stop or now_s - self._start_s >= self._limit_s
        if code is None and is_over and now_s >= self._ask_again_s:
            self._interrupt()
            self._ask_again_s = now_s + _PATIENCE_S
        return code

    def close(self) -> None:
        """Ask a running process to end with a checkpoint, and wait for its end."""
        if self.process.poll() is None:
            self._interrupt()
            self.process.wait()

    def _interrupt(self) -> None:
        """Send SIGINT to train.py, because torchrun would report SIGINT as a failure."""
        if not self._has_ranks:
            self.process.send_signal(signal.SIGINT)
            return
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        for pid in children.read_text(encoding="ascii").split()[:1]:  # all ranks end together
            os.kill(int(pid), signal.SIGINT)


def log_file(run: Run) -> Path:
    """Return the file with the output of train.py."""
    return run.folder / "train.log"


def train_all(
    plans: Sequence[Plan],
    slots: Sequence[Sequence[int]],
    is_stopped: Callable[[], bool],
    start: Callable[[Plan, Sequence[int]], Any] = Training,
    say: Callable[[str], None] = print,
    on_end: Callable[[Run], None] = lambda run: None,
) -> list[Run]:
    """Run all plans, one in each slot at a time, and return the failed runs.

    Args:
        plans: the plans in the order of their starts.
        slots: the CPUs of each slot.
        is_stopped: returns whether all runs should end now with checkpoints.
        start: starts a plan on CPUs and returns a `Training`.
        say: shows a line to the user.
        on_end: called with each successful run, unless `is_stopped` is true.
    """
    waiting, failed = list(plans), []
    active: dict[int, Any] = {}
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
