"""Runs the jobs of `train.py -m` and lists all jobs at the end, even if some of them fail.

Hydra composes the jobs and runs them in this process or in other processes. Each job has a separate
run folder and writes one line into `jobs.csv` in the sweep's folder.
"""

from __future__ import annotations

import contextlib
import csv
import logging
import math
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from isaacgymenvs_lite.errors import ConfigError, SweepError, UserError, one_line

log = logging.getLogger(__name__)

_FILE = "jobs.csv"
# Whether the user has ended the sweep; every process that runs jobs has a copy of this flag.
_ended_here = False


def check_words(words: Sequence[str]) -> None:
    """Refuse a sweep whose jobs would interfere with each other."""
    if not any(word in ("-m", "--multirun") or word.startswith("+study=") for word in words):
        return
    typed = {word.partition("=")[0].lstrip("+"): word.partition("=")[2] for word in words}
    if typed.get("checkpoint") == "last" and typed.get("test") != "True":
        raise ConfigError(
            "checkpoint=last with -m: each job would start from the job before it; give the path of"
            " a checkpoint"
        )
    if typed.get("pbt", "no_pbt") != "no_pbt":
        raise ConfigError(
            "pbt= with -m: -m trains one run after the other, but the policies of a population"
            " train at the same time; start a process for each policy: pbt.policy_idx=0, 1, ..."
        )
    name = typed.get("full_experiment_name", "")
    if name and "," not in name:
        raise ConfigError(
            f"full_experiment_name={name} with -m: all jobs would write into one folder; give"
            " experiment=NAME, to which each run adds its date and number"
        )


def run_job(run: Callable[..., float | None], parent: int) -> float | None:
    """Run the current job of a sweep, and add a line about it to the sweep's file.

    Args:
        run: trains a policy or plays one, as `runner.run` does; its arguments are `stop` and
            `direction`.
        parent: process id of the sweep.

    Returns:
        The result of the job. A failed job returns the worst result: infinity, or minus infinity
        if the direction is `maximize`.

    Raises:
        KeyboardInterrupt: the user has ended a sweep that runs in this process.
        SweepError: the sweep's settings are wrong for every job.
    """
    from isaacgymenvs_lite.run.stop_request import StopRequest  # imports torch

    global _ended_here
    direction: Any = getattr(HydraConfig.get().sweeper, "direction", "")
    direction = getattr(direction, "name", direction)  # some sweepers have an enumeration
    direction = direction if isinstance(direction, str) else ""
    stop = StopRequest()
    number, failure = None, "not started: the sweep was ended by the user" if _ended_here else ""
    if not failure:
        try:
            number = run(stop=stop, direction=direction)
        except SweepError:
            raise
        except UserError as error:
            failure = str(error)
        except Exception as error:
            failure = f"{type(error).__name__}: {one_line(error)}"
            log.exception("the job has failed")
    if stop.requested:
        if os.getpid() == parent:
            raise KeyboardInterrupt
        _ended_here = True
        failure = failure or "ended by the user"
    elif number is None and direction:
        failure = failure or "nothing to compare: no episode has ended; raise max_iterations"
    job = HydraConfig.get()
    written = "" if number is None else f"{number:.6g}"
    with Path(job.sweep.dir, _FILE).open("a", newline="", encoding="utf-8") as file:
        csv.writer(file).writerow([job.job.num, " ".join(job.overrides.task), written, failure])
    if failure:
        log.error("job #%d: %s", job.job.num, failure)
    # A sweeper runs further jobs after the worst result, but not after an error.
    worst = -math.inf if direction == "maximize" else math.inf
    return worst if failure else number


class Summary(Callback):
    """Lists the jobs at the end of a sweep; cfg/config.yaml registers it as a callback of Hydra."""

    num_failed = 0
    """Number of failed jobs of the sweep."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Log one line for each job, with the result of the job or the reason of its failure."""
        file = Path(config.hydra.sweep.dir, _FILE)
        if not file.is_file():
            return
        with file.open(newline="", encoding="utf-8") as lines:
            jobs = sorted(csv.reader(lines), key=lambda job: int(job[0]))
        words = [set(job[1].split()) for job in jobs]
        common = set.intersection(*words) if len(jobs) > 1 else set()
        for number, typed, value, failure in jobs:
            own = " ".join(word for word in typed.split() if word not in common)
            label = f"job #{number} {own}".rstrip()
            if failure:
                log.error("%s: %s", label, failure)
            else:
                log.info("%s: %s", label, value or "nothing was measured")
        Summary.num_failed = sum(bool(job[3]) for job in jobs)
        if Summary.num_failed:
            log.error("%d of %d jobs failed", Summary.num_failed, len(jobs))


@contextlib.contextmanager
def waiting_for_jobs() -> Iterator[None]:
    """After the first Ctrl-C wait until jobs in other processes have finished their epochs.

    A terminal sends Ctrl-C to all processes. A second Ctrl-C ends all processes at once.
    """
    pressed = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True
        log.warning("the sweep ends after the running jobs; a second Ctrl-C ends them at once")

    former = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
    if pressed:
        raise KeyboardInterrupt
