"""How much of the physics' speed is left in a task: env.step against raw Batch.step.

    python -m benchmarks.env_step [--task HumanoidAMP] [--num-envs 1024] [--threads 2] [--rounds 30]
        [key=value ...]

env.step is what an agent pays for: reset_done, actions, physics, observations, AMP history,
rewards, resets. The raw side is a `mujoco.batch.Batch` of its own with the same model, substeps and
threads.
Both take turns at every step, from the same states under the same controls, so that they do the
same physics and a drift of the machine's speed hits both; the copying in between is not timed.
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
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP

_STEPS_PER_ROUND = 10
# Exploration noise of AMP's policies, exp(-2.9), and of a policy of the classic tasks at its start.
_AMP_NOISE, _OTHER_NOISE = 0.055, 1.0


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    parser.add_argument("--task", default="HumanoidAMP")
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    seed_everything(0)
    sizes = [f"num_envs={args.num_envs}", f"num_threads={args.threads}"]
    cfg = compose([f"task={args.task}", *sizes, *args.overrides])
    env = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    noise = _AMP_NOISE if isinstance(env, HumanoidAMP) else _OTHER_NOISE
    simulation = env.simulation
    raw = Batch(simulation.model, args.num_envs, args.threads)
    env.reset()
    batch = simulation.batch  # type: ignore[attr-defined]
    raw_controls, controls = raw.bind("ctrl"), batch.bind("ctrl")

    def round_s() -> tuple[float, float]:
        """Return the times of the task and of the raw batch for some steps."""
        env_s = raw_s = 0.0
        for _ in range(_STEPS_PER_ROUND):
            actions = noise * torch.randn(args.num_envs, env.num_actions)
            if env.agents_call_reset_done:
                start = time.perf_counter()
                env.reset_done()
                env_s += time.perf_counter() - start

            raw.state[:] = batch.state
            start = time.perf_counter()
            env.step(actions)
            env_s += time.perf_counter() - start

            raw_controls[:] = controls
            start = time.perf_counter()
            raw.step(nstep=simulation.substeps)
            raw_s += time.perf_counter() - start
        return env_s, raw_s

    round_s()
    env_s, raw_s = zip(*(round_s() for _ in range(args.rounds)), strict=True)
    ratios = [raw / env for raw, env in zip(raw_s, env_s, strict=True)]
    frames = args.num_envs * _STEPS_PER_ROUND
    print(describe_machine())
    print(
        f"{args.task}, {args.num_envs} envs, {args.threads} threads, {simulation.substeps}"
        " substeps:"
        f" env.step {frames / statistics.median(env_s):,.0f} frames/s,"
        f" raw Batch.step {frames / statistics.median(raw_s):,.0f} frames/s,"
        f" ratio median {statistics.median(ratios):.3f}"
        f" (min {min(ratios):.3f}, max {max(ratios):.3f}, {args.rounds} rounds)"
    )


if __name__ == "__main__":
    main()
