"""What `kill -9` costs a training: epochs lost beyond the save interval, files that are broken.

    python -m benchmarks.torture [--kills 100] [--seed 1] [--parallel 2]

Tiny trainings of PPO, AMP, GenAMP and HRL are killed at random moments: while they start, before
the first episode has ended, while a file is written, and at any other time. Each is started again
where it was killed. A parent that has imported everything forks the trainings.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import random
import re
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, field, fields
from multiprocessing.process import BaseProcess
from pathlib import Path

from benchmarks.machine import describe_machine
from isaacgymenvs_lite.checkpoints.run_config import resumed_tree
from isaacgymenvs_lite.checkpoints.training_state import read_training_state
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.registration import build_runner
from isaacgymenvs_lite.runner import run

GO_ON = "resume=last"
"""The word with which a killed training is started again."""

_CONFIG = "train.params.config"
_TINY = (
    *("num_envs=4", "num_threads=1", "rl_device=cpu", "max_iterations=1000000"),
    *("progress_interval=1e-9", "train.params.network.mlp.units=[16,8]"),
    *(f"{_CONFIG}.mixed_precision=False", f"{_CONFIG}.horizon_length=4"),
    *(f"{_CONFIG}.mini_epochs=1", f"++{_CONFIG}.keep_checkpoints=3"),
)
_TINY_AMP = (
    *("train.params.network.disc.units=[12,6]", f"{_CONFIG}.amp_batch_size=16"),
    *(f"{_CONFIG}.amp_obs_demo_buffer_size=16", f"{_CONFIG}.amp_replay_buffer_size=64"),
    f"{_CONFIG}.imitation_frequency=0",
)
TRAININGS = {
    "PPO": ("task=Cartpole", *_TINY),
    "AMP": ("task=HumanoidAMP", *_TINY, *_TINY_AMP),
    "GenAMP": ("task=HumanoidASE", *_TINY, *_TINY_AMP, "train.params.network.style.units=[10,6]"),
    "HRL": ("task=HumanoidASE", "train=HumanoidASEHRLPPO", *_TINY),
}
"""Words of the command line of each."""

# In the log of a training that goes on without rows that were stored.
_NO_BUFFERS = b"replay buffers start empty"

_SAVE_INTERVALS = (1, 1, 5)
"""Epochs between checkpoints; the runs of an agent take them in turns."""
_KILLS_OF_A_RUN = 6
_START_LIMIT_S = 120.0
_WRITE_LIMIT_S = 10.0
_MAX_PAUSE_S = 0.5
_POLL_S = 2e-3


@dataclass
class Result:
    """What was done to the trainings of one agent, and what it cost."""

    kills: int = 0
    resumed: int = 0
    """Kills after which the training went on."""
    starting: int = 0
    """Kills before the first epoch."""
    writing: int = 0
    """Kills that left a half-written file."""
    no_episode: int = 0
    """Kills of runs without an ended episode so far."""
    lost: int = 0
    """Epochs, beyond the save interval."""
    unreadable: int = 0
    """Checkpoints."""
    failures: list[str] = field(default_factory=list)

    @property
    def is_good(self) -> bool:
        """Whether every kill cost nothing."""
        return self.kills == self.resumed and not (self.lost or self.unreadable or self.failures)


class _FailedError(Exception):
    """A training ended by itself, or did not begin."""


class _Run:
    """A training that is killed and started again, in a folder of its own.

    Args:
        words: of its command line.
        folder: where it runs; empty.
        interval: epochs between its checkpoints.
        result: what happens is added to it.
        rng: of the moments.
    """

    def __init__(
        self,
        words: Sequence[str],
        folder: Path,
        interval: int,
        result: Result,
        rng: random.Random,
    ) -> None:
        folder.mkdir(parents=True)
        self._words = (*words, f"{_CONFIG}.save_frequency={interval}")
        self._folder, self._interval, self._result, self._rng = folder, interval, result, rng
        self._log = folder / "train.log"
        self._read = 0
        self._process: BaseProcess | None = None
        self._start_s = 1.0
        self._last_epoch = 0
        self._waiting = 0
        """Kills since the training last went on."""

    def start(self) -> None:
        """Start the training, from its newest checkpoint if there is one."""
        goes_on = bool(self._checkpoints())
        self._read = self._log.stat().st_size if self._log.exists() else 0
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([_train.__module__])
        arguments = (self._words, goes_on, self._folder, self._log)
        process = context.Process(target=_train, args=arguments, daemon=True)
        process.start()
        self._process = process

    def kill_while_starting(self) -> None:
        """Kill before the first epoch, if the training is not faster than before."""
        time.sleep(self._rng.uniform(0.0, self._start_s))
        seen = self._epochs()
        self._result.starting += not seen
        if seen:
            self._check_start(seen[0])
        self._kill()

    def kill_after_start(self, moment: Callable[[_Run], object]) -> None:
        """Kill at a moment after the first epoch."""
        self.wait_for_epoch()
        moment(self)
        self._kill()

    def wait_for_epoch(self) -> None:
        """Wait for the first epoch of this start, and check that it is the right one.

        Raises:
            _FailedError: the training ended by itself or takes too long.
        """
        begin = time.monotonic()
        while not (seen := self._epochs()):
            self._check_alive(begin)
            time.sleep(_POLL_S)
        self._start_s = time.monotonic() - begin
        self._check_start(seen[0])

    def pause(self) -> None:
        """Let the training go on for a random time."""
        time.sleep(self._rng.uniform(0.0, _MAX_PAUSE_S))

    def wait_for_write(self) -> None:
        """Wait until a file is being written, and hold the training there."""
        assert self._process is not None
        assert self._process.pid is not None
        begin = time.monotonic()
        while time.monotonic() - begin < _WRITE_LIMIT_S:
            if self._is_writing():
                os.kill(self._process.pid, signal.SIGSTOP)
                if self._is_writing():
                    return
                os.kill(self._process.pid, signal.SIGCONT)
            time.sleep(_POLL_S)

    def wait_for_later_write(self) -> None:
        """Wait until one of the next files is being written."""
        self.pause()
        self.wait_for_write()

    def end(self) -> None:
        """Check that the last kill cost nothing; end the process."""
        try:
            self.start()
            self.wait_for_epoch()
        finally:
            self._stop()

    def _check_start(self, first_epoch: int) -> None:
        lost = self._last_epoch - self._interval - (first_epoch - 1)
        self._result.lost += max(0, lost)
        if _NO_BUFFERS in self._log_of_start():
            self._result.failures.append(f"{self._folder.name}: resumed without its buffers")
        self._result.resumed += self._waiting
        self._waiting = self._last_epoch = 0

    def _kill(self) -> None:
        self._check_alive(time.monotonic())
        self._stop()
        self._result.kills += 1
        self._waiting += 1
        self._last_epoch = max([self._last_epoch, *self._epochs()])
        self._result.writing += self._is_writing()
        files = self._checkpoints()
        names = [file.name for file in files if file.parent.name == "nn"]
        self._result.no_episode += all("rew_-inf" in name for name in names)
        for file in files:
            try:
                read_training_state(file)
            except CheckpointError as error:
                self._result.unreadable += 1
                self._result.failures.append(str(error))

    def _stop(self) -> None:
        process = self._process
        if process is not None and process.pid is not None and process.is_alive():
            os.kill(process.pid, signal.SIGKILL)
            process.join()

    def _check_alive(self, begin: float) -> None:
        assert self._process is not None
        if not self._process.is_alive() or time.monotonic() - begin > _START_LIMIT_S:
            lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
            raise _FailedError(f"{self._folder.name}: {lines[-1] if lines else 'no log'}")

    def _epochs(self) -> list[int]:
        """Return the epochs that this start of the training has logged."""
        return [int(number) for number in re.findall(rb"(?m)^epoch (\d+)/", self._log_of_start())]

    def _log_of_start(self) -> bytes:
        if not self._log.exists():
            return b""
        with self._log.open("rb") as file:
            file.seek(self._read)
            return file.read()

    def _is_writing(self) -> bool:
        """Return whether there is a file that this start of the training has half written."""
        assert self._process is not None
        return any(self._folder.glob(f"runs/*/*/.*.{self._process.pid}.partial"))

    def _checkpoints(self) -> list[Path]:
        """Return all files that a training could go on from."""
        files = self._folder.glob("runs/*/*/*.pth")
        return [file for file in files if not file.name.endswith("_buffers.pth")]


_MOMENTS = (_Run.wait_for_later_write, _Run.pause, _Run.wait_for_write, _Run.pause)


def _train(words: Sequence[str], goes_on: bool, folder: Path, log: Path) -> None:
    """Train in a process of its own, or go on with what trained, with the log in a file."""
    os.chdir(folder)
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(file, stream)
    logging.basicConfig(level=logging.INFO, format="%(message)s", force=True)
    run(resumed_tree([GO_ON]) if goes_on else compose(words))


def torture(name: str, kills: int, folder: Path, seed: int) -> Result:
    """Kill the training `name` of `TRAININGS` a number of times.

    Args:
        name: of the training.
        kills: to make.
        folder: of its runs.
        seed: of the moments.
    """
    rng, result, number = random.Random(f"{name} {seed}"), Result(), 0
    while result.kills < kills and len(result.failures) < 3:
        interval = _SAVE_INTERVALS[number % len(_SAVE_INTERVALS)]
        training = _Run(TRAININGS[name], folder / f"{name}{number}", interval, result, rng)
        goal = min(kills, result.kills + _KILLS_OF_A_RUN)
        try:
            _torture_run(training, goal, number, result, rng)
        except _FailedError as error:
            result.failures.append(str(error))
        number += 1
    return result


def _torture_run(
    training: _Run, goal: int, number: int, result: Result, rng: random.Random
) -> None:
    """Kill a run until the goal is reached, for the first time soon after its first epoch."""
    training.start()
    training.kill_after_start(_MOMENTS[number % len(_MOMENTS)])
    while result.kills < goal:
        training.start()
        if rng.random() < 1 / 6:
            training.kill_while_starting()
        else:
            training.kill_after_start(rng.choice(_MOMENTS))
    training.end()


def main(arguments: Sequence[str] | None = None) -> int:
    """Torture all trainings and print a table; return 0 if nothing was lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=100, help="of all trainings together")
    parser.add_argument("--seed", type=int, default=1, help="of the moments")
    parser.add_argument("--parallel", type=int, default=2, help="trainings at a time")
    args = parser.parse_args(arguments)
    print(f"{describe_machine()}; seed {args.seed}, {GO_ON}")
    each = -(-args.kills // len(TRAININGS))
    begin = time.monotonic()
    with (
        tempfile.TemporaryDirectory() as folder,
        ThreadPoolExecutor(args.parallel) as pool,
    ):
        jobs = {
            name: pool.submit(torture, name, each, Path(folder), args.seed) for name in TRAININGS
        }
        results = {name: job.result() for name, job in jobs.items()}
    columns = [f.name for f in fields(Result)[:-1]]
    print(f"{'':8}" + "".join(f"{column:>12}" for column in columns))
    for name, result in results.items():
        print(f"{name:8}" + "".join(f"{number:12}" for number in astuple(result)[:-1]))
    totals = (sum(getattr(r, column) for r in results.values()) for column in columns)
    print(f"{'all':8}" + "".join(f"{number:12}" for number in totals))
    for result in results.values():
        for failure in result.failures:
            print(failure)
    print(f"{time.monotonic() - begin:.0f} s")
    return 0 if all(result.is_good for result in results.values()) else 1


# What a training imports when it begins, imported before it is forked.
build_runner()

if __name__ == "__main__":
    sys.exit(main())
