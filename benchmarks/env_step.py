"""Compares the speed of a task's env.step with the speed of MuJoCo's raw Batch.step.

    python -m benchmarks.env_step [--task HumanoidAMP] [--num-envs 1024] [--threads 2] [--rounds 30]
        [key=value ...]

The time of env.step includes reset_done, actions, physics, observations, AMP history, rewards and
resets. The raw side is a separate `mujoco.batch.Batch` with the same model, substeps and threads.
Both sides take turns at every step, from the same states and with the same controls. Therefore they
compute the same physics, and a drift of the machine's speed affects both. Copying the states is not
timed.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # train.py also sets it before importing torch

import torch
from mujoco.batch import Batch

from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP

_STEPS_PER_ROUND = 10
# Standard deviation of the actions: exp(-2.9) for AMP, and 1 for new policies of other tasks.
_AMP_NOISE, _OTHER_NOISE = 0.055, 1.0


def main() -> None:
    """Measure the two speeds and print their ratio."""
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
        """Return the seconds that the task and the raw batch need for one round."""
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

    round_s()  # warm-up
    env_s, raw_s = zip(*(round_s() for _ in range(args.rounds)), strict=True)
    ratios = [raw / env for raw, env in zip(raw_s, env_s, strict=True)]
    frames = args.num_envs * _STEPS_PER_ROUND
    print(describe_machine())
    print(
        f"{args.task}, {args.num_envs} envs, {args.threads} threads,"
        f" {simulation.substeps} substeps:"
        f" env.step {frames / statistics.median(env_s):,.0f} frames/s,"
        f" raw Batch.step {frames / statistics.median(raw_s):,.0f} frames/s,"
        f" ratio median {statistics.median(ratios):.3f}"
        f" (min {min(ratios):.3f}, max {max(ratios):.3f}, {args.rounds} rounds)"
    )


if __name__ == "__main__":
    main()
