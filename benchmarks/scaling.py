"""How much faster several processes train: frames per second of ranks with one CPU each.

    python -m benchmarks.scaling [--ranks 2] [--num-envs 1024] [--epochs 6] [--rounds 2] [key=value]

Trains HumanoidAMP in turns, as torchrun starts it:

- 1 rank x 1 thread, pinned to one CPU;
- N ranks x 1 thread, each pinned to a CPU of its own, with as many environments each;
- 1 rank x N threads, with the environments and the minibatches of the N ranks together.

Prints the median frames per second of whole epochs of all ranks, the ratios, and the share of an
epoch that a rank spends in messages: with the time that it waits for the others in them, and
without, from the same messages sent one after the other by ranks that do nothing else. From these
parts it computes a table for more ranks: it is not measured. A ring sends 2 (n - 1) / n times the
gradient through each rank; the delay of a small message grows with log2 n.

Nothing else may run.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as train.py, before torch is imported

import torch
import torch.distributed as dist

from benchmarks.from_inside import EpochTimes, train_from_inside
from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent

# Until the replay buffer is full: its memory is touched for the first time before that.
_WARM_UP_EPOCHS = 14
_MINIBATCH, _AMP_MINIBATCH = 4096, 512
_TABLE = (4, 8, 16, 32, 64)


@dataclass(frozen=True)
class Times:
    """Of one training, seconds per epoch of its main rank.

    Attributes:
        epoch_s: a whole epoch.
        frames: of all ranks in an epoch.
        messages_s: in messages, waiting included.
        alone_s: of the same messages without anything else.
        small_s: of the messages of less than 64 kB alone.
    """

    epoch_s: float
    frames: int
    messages_s: float = 0.0
    alone_s: float = 0.0
    small_s: float = 0.0

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.frames / self.epoch_s


class Messages:
    """Times what a process sends, and stores the sizes."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.sizes: list[tuple[int, torch.dtype]] = []
        for name in ("all_reduce", "broadcast"):
            setattr(dist, name, self._timed(getattr(dist, name)))

    def clear(self) -> None:
        """Forget all messages."""
        self.seconds, self.sizes = 0.0, []

    def _timed(self, send: Any) -> Any:
        def timed(tensor: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            result = send(tensor, *args, **kwargs)
            self.seconds += time.perf_counter() - start
            self.sizes.append((tensor.numel(), tensor.dtype))
            return result

        return timed


def inside(args: argparse.Namespace) -> None:
    """Train as one rank; the main one writes its times to a file."""
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
    messages = Messages()
    results: list[Times] = []

    def at_end(agent: Any) -> None:
        per_epoch = 1.0 / len(times.seconds)
        seconds, sizes = messages.seconds * per_epoch, list(messages.sizes)
        alone_s, small_s = _time_alone(sizes) if ranks > 1 else (0.0, 0.0)
        epoch_s, frames = statistics.median(times.seconds), agent.batch_size * ranks
        alone = (alone_s * per_epoch, small_s * per_epoch)
        results.append(Times(epoch_s, frames, seconds, *alone))

    def between(agent: Any) -> None:
        if len(times.seconds) == 1:
            messages.clear()

    times = EpochTimes(AMPAgent.train_epoch, _WARM_UP_EPOCHS, args.epochs, between, at_end)
    train_from_inside(cfg, AMPAgent, times)
    if os.environ["RANK"] == "0":
        Path(args.out).write_text(json.dumps(asdict(results[0])))


def _time_alone(sizes: list[tuple[int, torch.dtype]]) -> tuple[float, float]:
    """Return the seconds of messages one after the other, of all and of the small ones."""
    total_s = small_s = 0.0
    for number, dtype in sizes:
        tensor = torch.zeros(number, dtype=dtype)
        start = time.perf_counter()
        dist.all_reduce(tensor)
        seconds = time.perf_counter() - start
        total_s += seconds
        small_s += seconds if tensor.nbytes < 2**16 else 0.0
    return total_s, small_s


def measure(args: argparse.Namespace, ranks: int, threads: int, num_envs: int) -> Times:
    """Return the times of a training in processes of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "times.json"
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
        command += [f"--nproc-per-node={ranks}", "-m", "benchmarks.scaling", *args.overrides]
        command += ["--inside", "--out", str(out), "--folder", folder, "--threads", str(threads)]
        command += ["--num-envs", str(num_envs), "--epochs", str(args.epochs)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(done.stderr[-3000:])
        return Times(**json.loads(out.read_text()))


def computed(one: Times, several: Times, ranks: int, num_ranks: int) -> float:
    """Return the speed of `num_ranks` over one rank, from the parts of a measured training."""
    large_s = several.alone_s - several.small_s
    ring = (2 * (num_ranks - 1) / num_ranks) / (2 * (ranks - 1) / ranks)
    delays = math.log2(num_ranks) / math.log2(ranks)
    messages_s = large_s * ring + several.small_s * delays
    return num_ranks * one.epoch_s / (several.epoch_s - several.alone_s + messages_s)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--num-envs", type=int, default=1024, help="of each rank")
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
        print(f"{name:22} {statistics.median(each.fps for each in column):9,.0f} frames/s")
    for name, other in ((names[0], 0), (names[2], 2)):
        ratios = [each[1].fps / each[other].fps for each in rounds]
        print(
            f"{names[1]} / {name}: {statistics.median(ratios):.2f}"
            f" ({min(ratios):.2f} to {max(ratios):.2f} in {args.rounds} rounds)"
        )
    one, several, _ = rounds[-1]
    print(
        f"messages: {several.messages_s / several.epoch_s:.1%} of an epoch with waiting,"
        f" {several.alone_s / several.epoch_s:.1%} alone"
    )
    for num_ranks in _TABLE:
        ratio = computed(one, several, args.ranks, num_ranks)
        print(f"computed, {num_ranks} ranks on {num_ranks} CPUs: {ratio:.1f} times as fast as one")


if __name__ == "__main__":
    main()
