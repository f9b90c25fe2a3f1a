"""Measures how fast AMP trains: frames per second, a time profile, and the upper limit.

    python -m benchmarks.training_speed [--units 512 256] [--num-envs 512] [--epochs 8] [key=value]
    python -m benchmarks.training_speed --compare --units 1024 512
    python -m benchmarks.training_speed --against torch_deterministic=True

The first command trains HumanoidAMP with its default settings for some epochs. It prints

- the frames per second of whole epochs,
- a table with the time of each part of an epoch, measured around the agent's methods,
- the time of the unavoidable parts, which are timed between the epochs on tensors of the same
  shapes: raw `Batch.step`, policy outputs, discriminator outputs for the reward, gradient steps,
- the ratio of the training's speed to the speed of the unavoidable parts alone. It is the median
  over the epochs. Each epoch is compared with the parts that are timed right after it.

`--compare` trains in turns in separate processes, with the defaults and with the settings of the
published loop, and prints the ratio of the speeds. The published loop uses float32 and torch's own
threads, and it evaluates the critic for all environments after every step. `--against key=value`
compares the defaults with other settings.
"""

from __future__ import annotations

import argparse
import copy
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

if "--published" not in sys.argv:
    # train.py also sets this variable before it imports torch.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch
from mujoco.batch import Batch

from benchmarks import tables
from benchmarks.from_inside import EpochTimes, train_from_inside
from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import seed_everything
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent
from isaacgymenvs_lite.learning.cpu import parallel
from isaacgymenvs_lite.learning.cpu.parallel import NetworkExecutor
from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

_WARM_UP_EPOCHS = 14  # until the replay buffer is full, which allocates memory

# The timed methods with their rows of the table. A nested call does not count for the outer call.
_TIMED: tuple[tuple[type, str, str], ...] = (
    (AMPAgent, "train_epoch", "rest of the epoch"),
    (AMPAgent, "play_steps", "rollout: rest"),
    (VecTask, "step", "environment: observations, rewards, ends"),
    (VecTask, "reset_done", "environment: resets"),
    (CpuBatchSimulation, "step", "environment: physics and its state tensors"),
    (AMPAgent, "get_action_values", "policy: actions and values"),
    (AMPAgent, "_eval_critic", "policy: values after the step"),
    (AMPAgent, "_calc_amp_rewards", "discriminator reward"),
    (AMPAgent, "discount_values", "advantages"),
    (AMPAgent, "_draw_disc_rows", "demonstrations and replay: sampling"),
    (AMPAgent, "_after_update", "demonstrations and replay: storing"),
    (AMPAgent, "prepare_dataset", "normalised values and advantages"),
    (AMPAgent, "_run_mini_epochs", "update: gathering minibatches"),
    (AMPAgent, "calc_gradients", "update: networks, losses and their gradients"),
    (AMPAgent, "prepare_minibatch", "update: statistics of the normalisers"),
    (AMPAgent, "trancate_gradients_and_step", "update: optimiser"),
    (AMPAgent, "_track_episodes", "episode statistics"),
    (AMPAgent, "write_stats", "logging"),
)


class Stopwatch:
    """Measures the time of nested calls; the time of an inner call counts for the inner only."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner: list[float] = []

    def time(self, label: str, call: Callable[[], Any]) -> Any:
        self._inner.append(0.0)
        start = time.perf_counter()
        try:
            return call()
        finally:
            taken = time.perf_counter() - start
            own = taken - self._inner.pop()
            self.seconds[label] = self.seconds.get(label, 0.0) + own
            if self._inner:
                self._inner[-1] += taken

    def wrap(self, owner: Any, name: str, label: str) -> None:
        method = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            return self.time(label, lambda: method(*args, **kwargs))

        setattr(owner, name, timed)


def train(
    args: argparse.Namespace,
    at_end: Callable[[Any, list[float]], str],
    between: Callable[[Any], None] = lambda agent: None,
) -> str:
    """Train for `args.epochs` epochs and return `at_end(agent, seconds of each epoch)`.

    `between(agent)` is called after each epoch and is not timed.
    """
    units = f"[{','.join(map(str, args.units))}]"
    cfg = compose(
        [
            f"num_envs={args.num_envs}",
            f"num_threads={args.threads}",
            f"train.params.network.mlp.units={units}",
            f"train.params.network.disc.units={units}",
            "train.params.config.imitation_frequency=0",
            f"+train.params.config.train_dir={args.folder}",
            *args.overrides,
        ]
    )
    seed_everything(0)
    texts: list[str] = []
    times = EpochTimes(
        AMPAgent.train_epoch,
        _WARM_UP_EPOCHS,
        args.epochs,
        between,
        lambda agent: texts.append(at_end(agent, times.seconds)),
    )
    train_from_inside(cfg, AMPAgent, times)
    return texts[0]


def profile(args: argparse.Namespace) -> None:
    watch = Stopwatch()
    for owner, name, label in _TIMED[1:]:
        watch.wrap(owner, name, label)
    left = _WARM_UP_EPOCHS
    former = AMPAgent.set_eval

    def set_eval(agent: Any) -> None:
        nonlocal left
        if left == 0:
            watch.seconds.clear()
        left -= 1
        former(agent)

    AMPAgent.set_eval = set_eval  # type: ignore[method-assign]

    def report(agent: Any, seconds: list[float]) -> str:
        spent = dict(watch.seconds)
        total, count = sum(seconds), len(seconds)
        fps = agent.batch_size / statistics.median(seconds)
        bits = "bfloat16" if agent.executor.bfloat16 else "float32"
        lines = [
            describe_machine(),
            f"networks {args.units}, {bits}, {args.num_envs} environments, {args.threads} threads",
            f"training: {fps:,.0f} frames/s (median of {count} epochs)",
            "",
        ]
        parts_inside = sorted(spent.items(), key=lambda row: -row[1])
        parts_inside.append(("not in any of these", total - sum(spent.values())))
        rows = [
            (label, f"{1e3 * value / count:.1f}", f"{100 * value / total:.1f}%")
            for label, value in parts_inside
        ]
        lines += [tables.markdown(("part", "ms per epoch", "share"), rows), ""]
        between = [
            (label, f"{1e3 * statistics.median(values):.1f}") for label, values in parts.items()
        ]
        lines.append(tables.markdown(("part, timed between the epochs", "ms per epoch"), between))
        limits = [sum(values) for values in zip(*parts.values(), strict=True)]
        ratios = [limit / epoch for limit, epoch in zip(limits, seconds, strict=True)]
        limit_fps = agent.batch_size / statistics.median(limits)
        lines.append(
            f"\nlimit {limit_fps:,.0f} frames/s; training / limit median"
            f" {statistics.median(ratios):.3f} (min {min(ratios):.3f}, max {max(ratios):.3f})"
        )
        return "\n".join(lines)

    parts: dict[str, list[float]] = {}

    def between(agent: Any) -> None:
        for label, value in time_parts(agent).items():
            parts.setdefault(label, []).append(value)

    print(train(args, report, between))


def time_parts(agent: Any) -> dict[str, float]:
    """Return the seconds of an epoch's unavoidable parts, each timed alone.

    The function restores the agent's weights and its optimiser.
    """
    env, network = agent.vec_env.env, agent.model.a2c_network
    simulation = env.simulation
    raw = Batch(simulation.model, env.num_envs, simulation.num_threads)
    obs = agent.obs["obs"]
    rollout = agent.experience_buffer.tensor_dict
    amp_obs = rollout["amp_obs"].flatten(0, 1)
    minibatch = rollout["obses"].flatten(0, 1)[: agent.minibatch_size]
    size = agent.dataset._row_limits["amp_obs"]
    steps = agent.mini_epochs_num * len(agent.dataset)

    def physics() -> None:
        # Each step starts from the same state, because fallen humanoids have more contacts.
        for _ in range(agent.horizon_length):
            raw.state[:] = simulation.batch.state
            raw.step(nstep=simulation.substeps)

    def acting() -> None:
        with torch.no_grad():
            for _ in range(agent.horizon_length):
                network({"obs": obs})

    def reward() -> None:
        with torch.no_grad():
            for rows in amp_obs.split(8192):
                network.eval_disc(rows)

    def gradient_step() -> None:
        mu, _, value, _ = network({"obs": minibatch})
        fakes = network.eval_disc(amp_obs[: 2 * size])
        logits, gradient = network.eval_disc_with_gradient(amp_obs[:size])
        terms = (mu, value, fakes, logits, gradient)
        agent.optimizer.zero_grad(set_to_none=True)
        torch.stack([term.square().mean() for term in terms]).sum().backward()
        agent.optimizer.step()

    def gradients() -> None:
        for _ in range(steps):
            gradient_step()

    parts = {
        f"raw Batch.step, {agent.horizon_length} times": physics,
        f"actor and critic for acting, {agent.horizon_length} times": acting,
        "discriminator on the rollout": reward,
        f"gradient steps on fixed tensors, {steps} times": gradients,
    }
    weights = copy.deepcopy(agent.model.state_dict())
    optimizer = copy.deepcopy(agent.optimizer.state_dict())
    seconds = {label: _least_s(part) for label, part in parts.items()}
    agent.model.load_state_dict(weights)
    agent.optimizer.load_state_dict(optimizer)
    return seconds


def _least_s(part: Callable[[], None]) -> float:
    """Return the shorter time of two calls in s."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        part()
        times.append(time.perf_counter() - start)
    return min(times)


def published_loop(args: argparse.Namespace) -> None:
    """Patch the agent to evaluate like the published loop, see the module docstring."""
    parallel.parallelize = lambda model, device, precision: NetworkExecutor(device)
    AMPAgent._needs_next_value = lambda agent: torch.ones_like(agent.dones, dtype=torch.bool)  # type: ignore[method-assign]
    reset = AMPAgent.env_reset

    def env_reset(agent: Any) -> Any:
        obs = reset(agent)
        torch.set_num_threads(args.threads)
        return obs

    AMPAgent.env_reset = env_reset  # type: ignore[method-assign]
    args.overrides.append("train.params.config.mixed_precision=False")


def compare(args: argparse.Namespace) -> None:
    """Train with the defaults and with the other settings in turns, and print the ratio."""

    def fps_with(*settings: str) -> float:
        command = [sys.executable, "-m", "benchmarks.training_speed", *settings]
        command += ["--fps", "--epochs", "5", "--num-envs", str(args.num_envs)]
        command += ["--threads", str(args.threads), *args.overrides]
        command += ["--units", *map(str, args.units)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
        return float(done.stdout.split()[-1])

    name = " ".join(args.against) or "published loop in float32"
    other = args.against or ["--published"]
    pairs = [(fps_with(), fps_with(*other)) for _ in range(args.rounds)]
    ratios = [ours / peer for ours, peer in pairs]
    ours, peer = (statistics.median(column) for column in zip(*pairs, strict=True))
    print(describe_machine())
    print(
        f"networks {args.units}: defaults {ours:,.0f} frames/s, {name}"
        f" {peer:,.0f} frames/s; ratio median {statistics.median(ratios):.2f}"
        f" (min {min(ratios):.2f}, max {max(ratios):.2f}, {args.rounds} rounds)"
    )


def main() -> None:
    """Measure the speed and print the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("overrides", nargs="*", help="settings, key=value")
    parser.add_argument("--units", type=int, nargs="+", default=[512, 256])
    parser.add_argument("--num-envs", type=int, default=512)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--folder", default="/tmp/isaacgymenvs_lite_benchmark")
    parser.add_argument("--compare", action="store_true")
    parser.add_argument(
        "--against", action="append", default=[], metavar="key=value", help="settings to compare"
    )
    parser.add_argument("--fps", action="store_true", help="print only the frames per second")
    parser.add_argument("--published", action="store_true", help="train with the published loop")
    args = parser.parse_intermixed_args()
    if args.published:
        published_loop(args)
    if args.compare or args.against:
        compare(args)
    elif args.fps:
        print(train(args, lambda agent, s: str(agent.batch_size / statistics.median(s))))
    else:
        profile(args)


if __name__ == "__main__":
    main()
