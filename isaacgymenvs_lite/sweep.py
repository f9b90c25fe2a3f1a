"""The jobs of `train.py -m`: a failed one does not end the others, and all are listed at the end.

Hydra composes the jobs and runs them, in this process or in others. Each job has its run folder, as
any training, and returns the number that `runner.run` returns.
"""

from __future__ import annotations

import contextlib
import io
import logging
import signal
import sys
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any, TextIO

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.hydra_bridge import JobResult
from isaacgymenvs_lite.errors import JobError, SweepError, UserError, one_line

log = logging.getLogger(__name__)

_SWEEPER = "hydra/sweeper="
_MAX_FAILURE_RATE = "hydra.sweeper.max_failure_rate"
_PROCESS = uuid.uuid4().hex
# Whether the user has ended the sweep in a process that runs its jobs.
_ended_here = False


def this_process() -> str:
    """Return a name of this process; numbers of processes repeat on other machines.

    A function, because a worker gets copies of the constants of a program (`python -m`).
    """
    return _PROCESS


def is_sweep() -> bool:
    """Return whether the running job of Hydra is one of a sweep."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def with_failures_allowed(words: Sequence[str]) -> list[str]:
    """Return a command line whose Optuna sweeper goes on after failed trials.

    By default it ends at the first one. A typed `hydra.sweeper.max_failure_rate=` counts instead.
    """
    is_optuna = f"{_SWEEPER}optuna" in words
    if not is_optuna or any(word.startswith(f"{_MAX_FAILURE_RATE}=") for word in words):
        return list(words)
    place = words.index(f"{_SWEEPER}optuna") + 1
    return [*words[:place], f"{_MAX_FAILURE_RATE}=1.0", *words[place:]]


class Sweep:
    """What became of the jobs of a sweep.

    Attributes:
        results: in the order of the jobs.
    """

    def __init__(self) -> None:
        self.results: list[JobResult] = []

    def add(self, results: Sequence[JobResult]) -> None:
        """Store the results of a batch."""
        self.results += results

    @property
    def num_failed(self) -> int:
        """Number of failed jobs."""
        return sum(result.error is not None for result in self.results)

    @property
    def all_failed(self) -> bool:
        """Whether there were jobs, and all of them have failed."""
        return 0 < self.num_failed == len(self.results)

    def report(self) -> None:
        """Log one line for each job, with its number or why it failed."""
        words = [set(result.words) for result in self.results]
        common = set.intersection(*words) if len(words) > 1 else set()
        for result in self.results:
            own = " ".join(word for word in result.words if word not in common)
            label = f"job #{result.number} {own}".rstrip()
            if result.error is not None:
                log.error("%s: %s", label, result.error)
            elif isinstance(result.value, float):
                log.info("%s: %.6g", label, result.value)
            else:
                log.info("%s: nothing was measured", label)
        if self.num_failed:
            log.error("%d of %d jobs failed", self.num_failed, len(self.results))


# --- one job --------------------------------------------------------------------------------------


def run_job(
    run: Callable[..., float | None], cfg: DictConfig, typed: Sequence[str], parent: str
) -> float | None:
    """Run the current job of a sweep.

    Args:
        run: receives `stop` and `direction`, and trains or plays as `runner.run` does.
        cfg: the composed tree of the job.
        typed: the words of the command line, sweeps included.
        parent: `this_process` of the sweep.

    Returns:
        The number of the job.

    Raises:
        SweepError: so would all others.
        JobError: the job has failed. Of other errors than a user's mistake the traceback is logged.
        KeyboardInterrupt: the user has ended the sweep, which runs in this process.
    """
    from isaacgymenvs_lite.run.stop_request import StopRequest  # imports torch

    global _ended_here
    if _ended_here:
        raise JobError("not started: the sweep was ended by the user")
    stop, direction = StopRequest(), _direction()
    number, failure = None, ""
    try:
        _check_job(cfg, typed)
        number = run(stop=stop, direction=direction)
    except SweepError:
        raise
    except UserError as error:
        failure = str(error)
        log.error("%s", error)
    except Exception as error:
        failure = f"{type(error).__name__}: {one_line(error)}"
        log.exception("the job has failed")
    if stop.requested:
        if parent == this_process():
            raise KeyboardInterrupt
        _ended_here = True
        failure = failure or "ended by the user"
    elif number is None and direction:
        failure = failure or "nothing to compare: no episode has ended; raise max_iterations"
    if failure:
        raise JobError(failure)
    return number


def _direction() -> str:
    """Return `minimize` or `maximize`, '' without a study or for one of several numbers."""
    direction: Any = getattr(HydraConfig.get().sweeper, "direction", "")
    name = getattr(direction, "name", direction)  # of an enumeration, or a word
    return name if isinstance(name, str) else ""


def _check_job(cfg: DictConfig, typed: Sequence[str]) -> None:
    """Refuse settings with which the jobs of a sweep would get into each other's way.

    Raises:
        SweepError: there is one.
    """
    if cfg.get("checkpoint") == "last" and not cfg.get("test"):
        raise SweepError(
            "checkpoint=last with -m: each job would start from the one before it; give the path of"
            " a checkpoint"
        )
    if OmegaConf.select(cfg, "pbt.enabled"):
        raise SweepError(
            "-m trains one run after the other, and the policies of a population train at the same"
            " time; start each in a process of its own: pbt.policy_idx=0, 1, ..."
        )
    name = cfg.get("full_experiment_name")
    if name and any(word.lstrip("+") == f"full_experiment_name={name}" for word in typed):
        raise SweepError(
            f"full_experiment_name={name} with -m: all jobs would write into one folder; give"
            " experiment=NAME, to which each run adds its date and number"
        )


# --- several processes ----------------------------------------------------------------------------


class _NumberedLines(io.TextIOBase):
    """A text stream that begins each line with the number of its job.

    The jobs of several processes write to one terminal. It is no terminal itself: progress is
    shown in lines.
    """

    def __init__(self, stream: TextIO, number: int) -> None:
        self._stream, self._start, self._rest = stream, f"#{number} ", ""

    def write(self, text: str) -> int:
        *lines, self._rest = (self._rest + text).split("\n")
        for line in lines:
            self._stream.write(f"{self._start}{line}\n")
        self._stream.flush()
        return len(text)


@contextlib.contextmanager
def numbered_output() -> Iterator[None]:
    """Begin all lines that a job writes in a process of its own with the job's number."""
    number = HydraConfig.get().job.num
    with (
        contextlib.redirect_stdout(_NumberedLines(sys.stdout, number)),
        contextlib.redirect_stderr(_NumberedLines(sys.stderr, number)),
    ):
        yield


@contextlib.contextmanager
def waiting_for_jobs() -> Iterator[None]:
    """Let the first Ctrl-C wait for jobs in other processes, which end after their epochs.

    A terminal sends it to all processes. The second one ends all of them at once.

    Raises:
        KeyboardInterrupt: after the jobs, or at the second Ctrl-C.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return
    pressed = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True
        log.warning("the sweep ends with the running jobs; once more ends them at once")

    former = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
    if pressed:
        raise KeyboardInterrupt
