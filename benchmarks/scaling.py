"""Measures how much faster several processes (ranks) train than one process.

    python -m benchmarks.scaling [--ranks 2] [--num-envs 1024] [--epochs 6] [--rounds 2] [key=value]

The command trains HumanoidAMP with torchrun, in turns with

- 1 rank x 1 thread, which is pinned to one CPU;
- N ranks x 1 thread, each with its own CPU and with the same number of environments;
- 1 rank x N threads, with the environments and the minibatches of all N ranks.

It prints the median frames per second of whole epochs, summed over the ranks, and the ratios. The
machine must be idle.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # train.py also sets it before importing torch

from benchmarks.from_inside import EpochTimes, train_from_inside
from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent

_WARM_UP_EPOCHS = 14  # until the replay buffer is full, which allocates memory
_MINIBATCH, _AMP_MINIBATCH = 4096, 512


def inside(args: argparse.Namespace) -> None:
    """Train as one rank; rank 0 writes the frames per second of all ranks to a file."""
    ranks = int(os.environ["WORLD_SIZE"])
    if args.threads == 1:
        cpus = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cpus[int(os.environ["LOCAL_RANK"]) % len(cpus)]})
    cfg = compose(
        [
            *("task=HumanoidAMP", "rl_device=cpu", f"multi_gpu={ranks > 1}"),
            f"num_envs={args.num_envs}",
            f"num_threads={args.threads}",
            f"train.params.config.minibatch_size={_MINIBATCH * args.threads}",
            f"train.params.config.amp_minibatch_size={_AMP_MINIBATCH}",
            f"train.params.config.amp_batch_size={_AMP_MINIBATCH}",
            "train.params.config.imitation_frequency=0",
            f"+train.params.config.train_dir={args.folder}",
            *args.overrides,
        ]
    )

    def at_end(agent: Any) -> None:
        fps = agent.batch_size * ranks / statistics.median(times.seconds)
        if os.environ["RANK"] == "0":
            Path(args.out).write_text(str(fps))

    times = EpochTimes(
        AMPAgent.train_epoch, _WARM_UP_EPOCHS, args.epochs, lambda agent: None, at_end
    )
    train_from_inside(cfg, AMPAgent, times)


def measure(args: argparse.Namespace, ranks: int, threads: int, num_envs: int) -> float:
    """Return the frames per second of a training in `ranks` new processes."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "fps.txt"
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
        command += [f"--nproc-per-node={ranks}", "-m", "benchmarks.scaling", *args.overrides]
        command += ["--inside", "--out", str(out), "--folder", folder, "--threads", str(threads)]
        command += ["--num-envs", str(num_envs), "--epochs", str(args.epochs)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(done.stderr[-3000:])
        return float(out.read_text())


def main() -> None:
    """Measure the three configurations and print the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--num-envs", type=int, default=1024, help="environments of each rank")
    parser.add_argument("--epochs", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=2)
    for hidden in ("--out", "--folder"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    parser.add_argument("--threads", type=int, default=1, help=argparse.SUPPRESS)
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_intermixed_args()
    if args.inside:
        inside(args)
        return
    rounds = [
        (
            measure(args, 1, 1, args.num_envs),
            measure(args, args.ranks, 1, args.num_envs),
            measure(args, 1, args.ranks, args.num_envs * args.ranks),
        )
        for _ in range(args.rounds)
    ]
    print(describe_machine())
    names = (
        "1 rank x 1 thread",
        f"{args.ranks} ranks x 1 thread",
        f"1 rank x {args.ranks} threads",
    )
    for name, column in zip(names, zip(*rounds, strict=True), strict=True):
        print(f"{name:22} {statistics.median(column):9,.0f} frames/s")
    for name, other in ((names[0], 0), (names[2], 2)):
        ratios = [fps[1] / fps[other] for fps in rounds]
        print(
            f"{names[1]} / {name}: {statistics.median(ratios):.2f}"
            f" ({min(ratios):.2f} to {max(ratios):.2f} in {args.rounds} rounds)"
        )


if __name__ == "__main__":
    main()
