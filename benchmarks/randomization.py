"""What domain randomisation costs: env.step with it against env.step without.

    python -m benchmarks.randomization [--task Ant] [--num-envs 1024] [--threads 2] [--rounds 30]

Two tasks take turns, ten steps each, under random actions; the task's published parameters,
resets and what is drawn at them included.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as train.py, before torch is imported

import torch

from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

_STEPS_PER_ROUND = 10
_WARM_UP_ROUNDS = 5


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    seed_everything(0)
    plain, randomised = (
        make_from_config(
            compose(
                [
                    f"task={args.task}",
                    f"num_envs={args.num_envs}",
                    f"num_threads={args.threads}",
                    f"task.task.randomize={randomize}",
                ]
            ),
            sim_device="cpu",
            rl_device="cpu",
        )
        for randomize in (False, True)
    )
    times = [(_round_s(plain), _round_s(randomised)) for _ in range(_WARM_UP_ROUNDS + args.rounds)]
    plain_s, randomised_s = zip(*times[_WARM_UP_ROUNDS:], strict=True)
    ratios = [a / b for a, b in zip(plain_s, randomised_s, strict=True)]
    frames = args.num_envs * _STEPS_PER_ROUND
    print(describe_machine())
    print(
        f"{args.task}, {args.num_envs} envs, {args.threads} threads: randomised"
        f" {frames / statistics.median(randomised_s):,.0f} frames/s, plain"
        f" {frames / statistics.median(plain_s):,.0f} frames/s, ratio median"
        f" {statistics.median(ratios):.3f} (min {min(ratios):.3f}, max {max(ratios):.3f},"
        f" {args.rounds} rounds)"
    )


def _round_s(env: VecTask) -> float:
    spent = 0.0
    for _ in range(_STEPS_PER_ROUND):
        actions = torch.randn(env.num_envs, env.num_actions)
        start = time.perf_counter()
        env.step(actions)
        spent += time.perf_counter() - start
    return spent


if __name__ == "__main__":
    main()
