"""How much of the low-level controller's speed is left when a high level learns over it.

    python -m benchmarks.hierarchy_speed LLC_CHECKPOINT [--num-envs 1024] [key=value ...]

Epochs of training on HumanoidHeading (rollout and update) take turns with the same number of
control steps of the same environments driven by the frozen low-level controller alone, under random
latents (resets, its forward pass, env.step). Prints control steps per second of both and their
ratio.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as train.py, before torch is imported

import torch

from benchmarks.experiments import override
from benchmarks.from_inside import MeasuredError, train_from_inside
from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import seed_everything
from isaacgymenvs_lite.learning.hrl_continuous import HRLAgent
from isaacgymenvs_lite.learning.skills.latents import sample_latents

_WARM_UP_ROUNDS = 2


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("llc_checkpoint", help="a .pth file or a shipped policy")
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_intermixed_args()
    epoch = HRLAgent.train_epoch
    pairs: list[tuple[float, float]] = []
    texts: list[str] = []

    def measured(agent: Any) -> Any:
        for _ in range(_WARM_UP_ROUNDS + args.rounds):
            start = time.perf_counter()
            epoch(agent)
            between = time.perf_counter()
            drive(agent)
            pairs.append((between - start, time.perf_counter() - between))
        steps = agent.horizon_length * agent.control_steps_per_action * agent.num_actors
        texts.append(report(pairs[_WARM_UP_ROUNDS:], steps, args))
        raise MeasuredError

    seed_everything(0)
    with tempfile.TemporaryDirectory() as folder:
        cfg = compose(
            [
                "task=HumanoidHeading",
                f"num_envs={args.num_envs}",
                f"num_threads={args.threads}",
                override("train.params.config.llc_checkpoint", args.llc_checkpoint),
                f"+train.params.config.train_dir={folder}",
                *args.overrides,
            ]
        )
        train_from_inside(cfg, HRLAgent, measured)
    print(describe_machine(), *texts, sep="\n")


def drive(agent: Any) -> None:
    """Make the control steps of an epoch with the low-level controller alone."""
    env = agent.vec_env.env
    for _ in range(agent.horizon_length):
        obs, _ = env.reset_done()
        latents = sample_latents(env.num_envs, agent.llc.latent_dim)
        for _ in range(agent.control_steps_per_action):
            with torch.no_grad():
                actions = agent.llc.actions(obs["obs"], latents)
            obs, *_ = env.step(actions)


def report(pairs: list[tuple[float, float]], steps: int, args: argparse.Namespace) -> str:
    """Return the medians on one line."""
    training, alone = zip(*pairs, strict=True)
    ratios = [b / a for a, b in pairs]
    return (
        f"HumanoidHeading, {args.num_envs} envs, {args.threads} threads:"
        f" training {steps / statistics.median(training):,.0f} control steps/s,"
        f" low level alone {steps / statistics.median(alone):,.0f} control steps/s,"
        f" ratio median {statistics.median(ratios):.3f}"
        f" (min {min(ratios):.3f}, max {max(ratios):.3f}, {len(ratios)} rounds)"
    )


if __name__ == "__main__":
    main()
