"""How fast Stable-Baselines3 trains with the threads that it gets, with and without other load.

    python -m benchmarks.threads [script|workflow] [--task Ant] [--num-envs 64] [--batch-size 512]
        [--frames 16384] [--rounds 3] [--torch-first] [--load idle|busy|both]

`script` is the example of docs/other_libraries.md, `workflow` the command
`isaacgymenvs-lite workflows sb3 train`. Each is run with nothing set, as a user has it,
and with its peers: torch's own choice (all CPUs, idle threads that spin, as before this project set
anything), all CPUs with OMP_WAIT_POLICY=PASSIVE, and one thread. The runs take turns, each in a
process of its own. Under load a process for each CPU does nothing but work.

Prints frames per second, and how many times as fast nothing set is as each peer. Other work on the
machine is load as well: a figure without load needs a machine with nothing else running.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

# Nothing is imported here that imports torch: the order is what `--torch-first` is about.

_NAMES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
_OURS = "nothing set"


def _peers(cpus: str) -> dict[str, dict[str, str]]:
    """Return what is set for nothing and for each peer; 300000 is libgomp's own number."""
    return {
        _OURS: {},
        "torch's own choice": {"OMP_NUM_THREADS": cpus, "GOMP_SPINCOUNT": "300000"},
        "all CPUs, PASSIVE": {"OMP_NUM_THREADS": cpus, "OMP_WAIT_POLICY": "PASSIVE"},
        "one thread": {"OMP_NUM_THREADS": "1"},
    }


def main() -> None:
    """Measure and print."""
    args = _parser().parse_args()
    if args.side:
        print(_script(args) if args.program == "script" else _workflow(args))
        return
    from benchmarks.machine import describe_machine

    print(f"{describe_machine()}; load average at the start {os.getloadavg()[0]:.1f}")
    for load in ("idle", "busy") if args.load == "both" else (args.load,):
        with _busy_cpus() if load == "busy" else contextlib.nullcontext():
            _compare(args, load)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("program", nargs="?", choices=["script", "workflow"], default="script")
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--batch-size", type=int, default=512, help="of the script")
    parser.add_argument("--frames", type=int, default=16384)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--torch-first", action="store_true", help="before the package")
    parser.add_argument("--load", choices=["idle", "busy", "both"], default="both")
    parser.add_argument("--side", action="store_true", help="one number: frames per second")
    return parser


def _compare(args: argparse.Namespace, load: str) -> None:
    clean = {name: value for name, value in os.environ.items() if name not in _NAMES}
    words = [args.program, "--side", "--task", args.task, "--num-envs", str(args.num_envs)]
    words += ["--batch-size", str(args.batch_size), "--frames", str(args.frames)]
    words += ["--torch-first"] * args.torch_first
    peers = _peers(str(len(os.sched_getaffinity(0))))
    from benchmarks.from_inside import last_number_of

    rates: dict[str, list[float]] = {name: [] for name in peers}
    for _ in range(args.rounds):
        for name, variables in peers.items():
            environment = {**clean, **variables}
            rates[name].append(
                last_number_of("benchmarks.threads", *words, environment=environment)
            )
    order = ", torch imported first" if args.torch_first else ""
    print(f"{args.program}, {args.task}, {args.num_envs} environments{order}, {load}:")
    for name, measured in rates.items():
        ratios = [ours / peer for ours, peer in zip(rates[_OURS], measured, strict=True)]
        compared = (
            ""
            if name == _OURS
            else f"; nothing set is {statistics.median(ratios):.2f} times as fast"
            f" ({min(ratios):.2f} to {max(ratios):.2f}, {args.rounds} rounds)"
        )
        print(f"  {name}: {statistics.median(measured):,.0f} frames/s{compared}", flush=True)


@contextlib.contextmanager
def _busy_cpus() -> Iterator[None]:
    """Keep every CPU busy with a process of ordinary priority."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command) for _ in os.sched_getaffinity(0)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _script(args: argparse.Namespace) -> float:
    """Train as docs/other_libraries.md does and return the frames per second behind one rollout."""
    if args.torch_first:
        import torch  # noqa: F401
    import isaacgymenvs_lite  # isort: skip
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from isaacgymenvs_lite.wrappers import Sb3VecEnvWrapper

    task = isaacgymenvs_lite.make(task=args.task, num_envs=args.num_envs)
    env = VecNormalize(Sb3VecEnvWrapper(task))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=args.batch_size, device="cpu", seed=1)
    model.learn(1)  # a rollout
    start_s = time.perf_counter()
    model.learn(args.frames)
    return model.num_timesteps / (time.perf_counter() - start_s)


def _workflow(args: argparse.Namespace) -> float:
    """Train as the command does and return the frames per second that it says."""
    from isaacgymenvs_lite.workflows.sb3 import LIBRARY
    from isaacgymenvs_lite.workflows.training import train

    with tempfile.TemporaryDirectory() as logs, contextlib.redirect_stdout(io.StringIO()) as said:
        words = [f"task={args.task}", f"num_envs={args.num_envs}", f"logs={logs}"]
        words.append(f"max_iterations={max(2, args.frames // (32 * args.num_envs))}")
        if train(LIBRARY, words) != 0:
            raise RuntimeError("the training failed")
    return float(re.findall(r"fps\s*\|\s*(\d+)", said.getvalue())[-1])


if __name__ == "__main__":
    main()
