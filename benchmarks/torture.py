"""What `kill -9` costs a training: epochs lost beyond the save interval, files that are broken.

    python -m benchmarks.torture [--kills 100] [--seed 1] [--parallel 2]

Tiny trainings of PPO, AMP, GenAMP and HRL are killed at random moments: while they start, while a
file is written, and at any other time. Each is started again where it was killed. A slow machine
needs longer; only a training that ends by itself or shows nothing for `_HANG_S` is a failure.
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
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path

from benchmarks.machine import describe_machine
from isaacgymenvs_lite.checkpoints.run_config import resumed_tree
from isaacgymenvs_lite.checkpoints.training_state import read_training_state
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.runner import run

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

_SAVE_INTERVALS = (1, 1, 5)
"""Epochs between checkpoints; the runs of an agent take them in turns."""
_KILLS_OF_A_RUN = 6
_MOMENTS = ("write", "any", "any", "start")
_MAX_PAUSE_S = 0.5
_HANG_S = 900.0
# In the log of a training that goes on without rows that were stored.
_NO_BUFFERS = b"replay buffers start empty"


@dataclass
class Result:
    """The kills of one training, and what they cost."""

    kills: int = 0
    resumed: int = 0
    """Kills after which the training went on."""
    writing: int = 0
    """Kills that left a half-written file."""
    lost: int = 0
    """Epochs, beyond the save interval."""
    failures: list[str] = field(default_factory=list)

    @property
    def is_good(self) -> bool:
        """Whether every kill cost nothing."""
        return self.kills == self.resumed and not (self.lost or self.failures)


class _FailedError(Exception):
    """A training ended by itself, or hangs."""


class _Run:
    """A training in a folder of its own that is killed and started again."""

    def __init__(self, words: Sequence[str], folder: Path, interval: int, result: Result) -> None:
        folder.mkdir(parents=True)
        self._words = (*words, f"{_CONFIG}.save_frequency={interval}")
        self._folder, self._interval, self._result = folder, interval, result
        self._log = folder / "train.log"
        self._log.touch()
        self._process: BaseProcess | None = None
        self._read = self._last_epoch = self._waiting = 0

    def start(self) -> None:
        """Start the training, from its newest checkpoint if there is one."""
        self._read = self._log.stat().st_size
        arguments = (self._words, bool(self._checkpoints()), self._folder, self._log)
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["isaacgymenvs_lite.runner"])
        self._process = context.Process(target=_train, args=arguments, daemon=True)
        self._process.start()

    def check_start(self) -> None:
        """Wait for the first epoch of this start, and check that it is the right one."""
        self._wait(self._epochs)
        lost = self._last_epoch - self._interval - (self._epochs()[0] - 1)
        self._result.lost += max(0, lost)
        if _NO_BUFFERS in self._log_of_start():
            self._result.failures.append(f"{self._folder.name}: resumed without its buffers")
        self._result.resumed += self._waiting
        self._waiting = self._last_epoch = 0

    def kill(self, moment: str, pause_s: float) -> None:
        """Kill the training, and read all files that it could go on from."""
        if moment != "start":
            self.check_start()
        time.sleep(pause_s)
        if moment == "write":
            self._wait(self._holds_a_write)
        elif self._epochs() and self._waiting:  # it was faster than the pause
            self.check_start()
        self.stop()
        self._result.kills += 1
        self._waiting += 1
        self._last_epoch = max([self._last_epoch, *self._epochs()])
        self._result.writing += self._is_writing()
        for file in self._checkpoints():
            try:
                read_training_state(file)
            except CheckpointError as error:
                self._result.failures.append(str(error))

    def stop(self) -> None:
        """End the process."""
        process = self._process
        if process is not None and process.pid is not None and process.is_alive():
            os.kill(process.pid, signal.SIGKILL)
            process.join()

    def _wait(self, condition: Callable[[], object]) -> None:
        """Wait until a condition holds.

        Raises:
            _FailedError: the training ended by itself or hangs.
        """
        assert self._process is not None
        begin = time.monotonic()
        while not condition():
            if not self._process.is_alive() or time.monotonic() - begin > _HANG_S:
                lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
                raise _FailedError(f"{self._folder.name}: {lines[-1] if lines else 'no log'}")
            time.sleep(5e-3)

    def _holds_a_write(self) -> bool:
        """Pause the process if it is writing a file; return whether it did."""
        assert self._process is not None
        assert self._process.pid is not None
        if not self._is_writing():
            return False
        os.kill(self._process.pid, signal.SIGSTOP)
        if not self._is_writing():
            os.kill(self._process.pid, signal.SIGCONT)
        return self._is_writing()

    def _epochs(self) -> list[int]:
        """Return the epochs that this start of the training has logged."""
        return [int(number) for number in re.findall(rb"(?m)^epoch (\d+)/", self._log_of_start())]

    def _log_of_start(self) -> bytes:
        return self._log.read_bytes()[self._read :]

    def _is_writing(self) -> bool:
        """Return whether there is a file that this start of the training has half written."""
        assert self._process is not None
        return any(self._folder.glob(f"runs/*/*/.*.{self._process.pid}.partial"))

    def _checkpoints(self) -> list[Path]:
        files = self._folder.glob("runs/*/*/*.pth")
        return [file for file in files if not file.name.endswith("_buffers.pth")]


def _train(words: Sequence[str], goes_on: bool, folder: Path, log: Path) -> None:
    """Train in a process of its own, or go on with what trained, with the log in a file."""
    os.chdir(folder)
    file = os.open(log, os.O_WRONLY | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(file, stream)
    logging.basicConfig(level=logging.INFO, format="%(message)s", force=True)
    run(resumed_tree(["resume=last"]) if goes_on else compose(words))


def torture(name: str, kills: int, folder: Path, seed: int) -> Result:
    """Kill the training `name` of `TRAININGS` a number of times, in runs below a folder."""
    rng, result, number = random.Random(f"{name} {seed}"), Result(), 0
    while result.kills < kills and len(result.failures) < 3:
        interval = _SAVE_INTERVALS[number % len(_SAVE_INTERVALS)]
        training = _Run(TRAININGS[name], folder / f"{name}{number}", interval, result)
        goal = min(kills, result.kills + _KILLS_OF_A_RUN)
        try:
            moment = "write"
            while result.kills < goal:
                training.start()
                training.kill(moment, rng.uniform(0.0, _MAX_PAUSE_S))
                moment = rng.choice(_MOMENTS)
            training.start()
            training.check_start()
        except _FailedError as error:
            result.failures.append(str(error))
        finally:
            training.stop()
        number += 1
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Torture all trainings and print a table; return 0 if nothing was lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=100, help="of all trainings together")
    parser.add_argument("--seed", type=int, default=1, help="of the moments")
    parser.add_argument("--parallel", type=int, default=2, help="trainings at a time")
    args = parser.parse_args(arguments)
    print(f"{describe_machine()}; seed {args.seed}")
    each, begin = -(-args.kills // len(TRAININGS)), time.monotonic()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(args.parallel) as pool:
        jobs = [pool.submit(torture, name, each, Path(folder), args.seed) for name in TRAININGS]
        results = dict(zip(TRAININGS, (job.result() for job in jobs), strict=True))
    print(f"{'':8}{'kills':>10}{'resumed':>10}{'writing':>10}{'lost':>10}")
    for name, result in results.items():
        counts = (result.kills, result.resumed, result.writing, result.lost)
        print(f"{name:8}" + "".join(f"{count:10}" for count in counts))
        print("".join(f"{failure}\n" for failure in result.failures), end="")
    print(f"{time.monotonic() - begin:.0f} s")
    return 0 if all(result.is_good for result in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
