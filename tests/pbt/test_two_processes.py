"""Two real processes on Ant: the worse one starts again with the weights of the better one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from tests.tiny import CONFIG, DOWNHILL, TINY_PBT, UPHILL

REPOSITORY = Path(__file__).parents[2]
RATE = f"{CONFIG}.learning_rate"
# Networks stay what they are, so that each one can be recognised.
STILL = ["train.params.config.lr_schedule=constant", f"{RATE}=1e-9", "max_iterations=1000000"]
TIMES = ["pbt.interval_steps=320", "pbt.start_after=960"]


@contextmanager
def policy(folder: Path, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, str(REPOSITORY / "train.py"), *TINY_PBT, *STILL, *TIMES, *words]
    env = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    with (folder / f"{words[0]}.log").open("wb") as log:
        process = subprocess.Popen(command, cwd=folder, env=env, stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def wait_for(condition: Callable[[], bool], folder: Path) -> None:
    end = time.monotonic() + 60
    while not condition():
        logs = "\n".join(file.read_text()[-3000:] for file in folder.glob("*.log"))
        assert time.monotonic() < end, logs
        time.sleep(0.05)


def params(file: Path) -> dict[str, float]:
    return yaml.safe_load(file.read_text())["params"]


def distance(one: dict, other: dict) -> float:
    pairs = [(v, other["model"][n]) for n, v in one["model"].items() if "actor_mlp" in n]
    assert pairs
    return max(float((a - b).abs().max()) for a, b in pairs)


@pytest.mark.slow
def test_a_mutation_and_a_restart(tmp_path):
    good, bad = ("pbt.policy_idx=0", DOWNHILL, "seed=1"), ("pbt.policy_idx=1", UPHILL, "seed=2")
    with policy(tmp_path, *good) as better, policy(tmp_path, *bad) as worse:
        log = tmp_path / "pbt.policy_idx=1.log"
        wait_for(lambda: list(tmp_path.glob("runs/ws/001/0*.yaml")) != [], tmp_path)
        first = min(tmp_path.glob("runs/ws/001/0*.yaml"))
        before, own = params(first), load_checkpoint(first.with_suffix(".pth"))
        wait_for(lambda: list(tmp_path.glob("runs/ws/000/0*.yaml")) != [], tmp_path)
        better.send_signal(signal.SIGTERM)  # its records stay
        # Its second process starts from a checkpoint, and writes.
        wait_for(lambda: "\ncheckpoint: " in log.read_text(), tmp_path)
        number = max(int(f.stem) for f in tmp_path.glob("runs/ws/001/0*.yaml"))
        after = tmp_path / f"runs/ws/001/{number + 1:06d}.yaml"
        wait_for(after.exists, tmp_path)
        assert worse.poll() is None  # the same process id
        worse.send_signal(signal.SIGTERM)
        assert [process.wait(30) for process in (better, worse)] == [0, 0]
    text = log.read_text()
    assert "goes on with the weights of policy 0" in text
    assert "Traceback" not in text

    (run,) = tmp_path.glob("runs/Ant_pbt_01_*")  # both processes in one folder
    settings = OmegaConf.load(run / "config.yaml")
    assert settings.pbt_restart is True
    assert params(after)[RATE] != before[RATE] != OmegaConf.select(settings, RATE)

    theirs = load_checkpoint(min(tmp_path.glob("runs/ws/000/*.pth")))
    replaced = load_checkpoint(after.with_suffix(".pth"))
    assert distance(own, theirs) > 0.1
    assert distance(replaced, theirs) < 1e-4
    assert replaced["frame"] == yaml.safe_load(after.read_text())["frame"] > own["frame"]
    torch.testing.assert_close(replaced["epoch"] * 32, replaced["frame"])
