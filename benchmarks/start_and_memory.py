"""Measures the start time and the peak memory of `python train.py`.

    python -m benchmarks.start_and_memory [--num-envs 4096] [--epochs 18] [key=value ...]

The start time ends with the first progress line, which appears after the first epoch. It is an
upper bound of the time to the first training step. Memory is the peak resident size of the training
process. 18 epochs of 4096 x 16 samples fill the replay buffer of 1,000,000 rows.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.machine import describe_machine

_TRAIN = Path(__file__).resolve().parents[1] / "train.py"


def run_humanoid_amp(overrides: Sequence[str]) -> tuple[float, float]:
    """Return seconds to the first progress line and peak memory in GiB of one training."""
    first_epoch_s = float("nan")
    command = [sys.executable, str(_TRAIN), "task=HumanoidAMP", *overrides]
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        process = subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("epoch 1/"):
                first_epoch_s = time.perf_counter() - start
        if process.wait() != 0:
            raise SystemExit(f"train.py failed with exit code {process.returncode}")
    peak_kib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return first_epoch_s, peak_kib / 2**20


def main() -> None:
    """Measure start time and memory and print them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--epochs", type=int, default=18)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    print(describe_machine())
    first_epoch_s, _ = run_humanoid_amp(["max_iterations=1", *args.overrides])
    print(f"default size: first epoch finished {first_epoch_s:.1f} s after the command")
    _, peak_gib = run_humanoid_amp(
        [f"num_envs={args.num_envs}", f"max_iterations={args.epochs}", *args.overrides]
    )
    print(f"{args.num_envs} envs, {args.epochs} epochs: peak memory {peak_gib:.2f} GiB")


if __name__ == "__main__":
    main()
