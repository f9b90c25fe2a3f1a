"""`kill -9` at random moments of a training: no file is broken, and `resume=last` goes on."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from pathlib import Path

import pytest

from isaacgymenvs_lite.checkpoints.run_config import resumed_tree
from isaacgymenvs_lite.checkpoints.training_state import read_training_state
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.runner import run
from tests.tiny import CONFIG, TINY_AMP

pytestmark = pytest.mark.slow

_WORDS = (
    *("task=HumanoidAMP", *TINY_AMP, "max_iterations=1000000", f"{CONFIG}.save_frequency=1"),
    *(f"++{CONFIG}.keep_checkpoints=3", f"{CONFIG}.imitation_frequency=0"),
)
_KILLS, _LONGEST_WAIT_S = 4, 120.0


def _train(folder: Path, goes_on: bool) -> None:
    os.chdir(folder)
    run(resumed_tree(["resume=last"]) if goes_on else compose(_WORDS))


def _states(folder: Path) -> list[Path]:
    states = folder.glob("runs/*/resume/*.pth")
    return [file for file in states if not file.name.endswith("_buffers.pth")]


def _newest_epoch(folder: Path) -> int:
    return max((int(file.stem) for file in _states(folder)), default=0)


def test_a_killed_training_goes_on_from_its_last_epoch(tmp_path: Path) -> None:
    rng, epoch = random.Random(1), 0
    for _ in range(_KILLS):
        process = multiprocessing.get_context("spawn").Process(
            target=_train, args=(tmp_path, epoch > 0), daemon=True
        )
        process.start()
        begin = time.monotonic()
        while _newest_epoch(tmp_path) <= epoch:
            assert process.is_alive() and time.monotonic() - begin < _LONGEST_WAIT_S
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.3))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        for file in (*_states(tmp_path), *tmp_path.glob("runs/*/nn/*.pth")):
            state = read_training_state(file)
            assert file.parent.name == "nn" or state.buffers is not None
        assert _newest_epoch(tmp_path) > epoch
        epoch = _newest_epoch(tmp_path)
    assert len(list(tmp_path.glob("runs/*"))) == 1
