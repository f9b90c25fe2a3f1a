"""How much of the physics' speed is left in a task: env.step against raw Batch.step.

    python -m benchmarks.env_step [--num-envs 1024] [--threads 2] [--rounds 30] [motion_file]

Both step the same model with the same substeps and threads, in turns (A B A B ...), so that a
drift of the machine's speed hits both. env.step is what an agent pays for: reset_done, actions,
physics, observations, AMP history, rewards, resets. The raw side steps a `mujoco.batch.Batch` of
its own that holds the same kinds of states: it starts from the task's and is put back to them
before each round.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as train.py, before torch is imported

import torch
from mujoco.batch import Batch

from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.making import make_from_config, seed_everything

_STEPS_PER_ROUND = 10
_ACTION_NOISE = 0.055  # the exploration noise of AMP's policy, exp(-2.9)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("motion_file", nargs="?", default="walk.npz")
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    seed_everything(0)
    cfg = compose(
        [
            f"num_envs={args.num_envs}",
            f"num_threads={args.threads}",
            f"task.env.motion_file={args.motion_file}",
        ]
    )
    env = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    simulation = env.simulation
    raw = Batch(simulation.model, args.num_envs, args.threads)
    env.reset()
    actions = [_ACTION_NOISE * torch.randn(args.num_envs, 28) for _ in range(_STEPS_PER_ROUND)]

    def env_round() -> float:
        start = time.perf_counter()
        for action in actions:
            env.reset_done()
            env.step(action)
        return time.perf_counter() - start

    def raw_round() -> float:
        raw.state[:] = simulation._batch.state  # type: ignore[attr-defined]
        start = time.perf_counter()
        for _ in actions:
            raw.step(nstep=simulation.substeps)
        return time.perf_counter() - start

    env_round(), raw_round()
    env_s, raw_s = [], []
    for _ in range(args.rounds):
        env_s.append(env_round())
        raw_s.append(raw_round())
    ratios = [raw / env for raw, env in zip(raw_s, env_s, strict=True)]
    frames = args.num_envs * _STEPS_PER_ROUND
    print(describe_machine())
    print(
        f"HumanoidAMP, {args.num_envs} envs, {args.threads} threads, {simulation.substeps}"
        " substeps:"
        f" env.step {frames / statistics.median(env_s):,.0f} frames/s,"
        f" raw Batch.step {frames / statistics.median(raw_s):,.0f} frames/s,"
        f" ratio median {statistics.median(ratios):.3f}"
        f" (min {min(ratios):.3f}, max {max(ratios):.3f}, {args.rounds} rounds)"
    )


if __name__ == "__main__":
    main()
