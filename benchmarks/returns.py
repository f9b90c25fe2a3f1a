"""Measures policies of the classic tasks by their returns.

    python -m benchmarks.returns TARGET [TARGET ...] [key=value ...]
        [--runs-dir runs/benchmarks] [--write]

`benchmarks.evaluate` describes the targets. Each policy plays 128 episodes with mean actions, one
episode in each environment, from the same starts. The return is the sum of the task's rewards over
an episode. `--write` adds the results to benchmarks/results.
"""

from __future__ import annotations

import logging
import statistics
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.played import append_result, find_targets, parser_of
from benchmarks.protocol import SEED, play_checkpoint
from benchmarks.runs import Run
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.evaluation.evaluate import evaluate

EPISODES = 128
_FIXED = {"num_envs": EPISODES, "task.env.numEnvs": EPISODES, "task.task.randomize": False}


@dataclass(frozen=True, kw_only=True)
class Returns:
    """Measurements of a policy as means over the episodes.

    Attributes:
        episode_return: sum of the task's rewards.
        steps: number of control steps.
        max_steps: number of control steps without early termination.
        successes: name -> mean at the ends of the episodes, for tasks that count successes.
    """

    episode_return: float
    steps: float
    max_steps: int
    successes: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        counted = "".join(f", {name} {mean:.3f}" for name, mean in self.successes.items())
        steps = f"{self.steps:.0f} of {self.max_steps} steps"
        return f"return {self.episode_return:.2f}, {steps}{counted}"


def measure_returns(player: Any, env: Any) -> Returns:
    """Play a policy, see the module docstring."""
    result = evaluate(env, player.act, EPISODES, on_step=getattr(player, "on_step", None))
    return Returns(
        episode_return=result.reward,
        steps=result.steps,
        max_steps=env.max_episode_length - 1,
        successes=result.successes,
    )


def measure_and_keep(
    run: Run,
    checkpoint: Path,
    results_dir: Path | None,
    seed: int = SEED,
    num_threads: int = 1,
    overrides: tuple[str, ...] = (),
) -> Returns:
    """Play a checkpoint of a run, print the result, and append it to a file in `results_dir`.

    Other arguments and errors are the arguments and errors of `play_checkpoint`.
    """
    found = play_checkpoint(
        checkpoint, measure_returns, _FIXED, seed, num_threads=num_threads, overrides=overrides
    )
    print(f"{run.label}: {found}", flush=True)
    if results_dir is not None:
        name, steps = run.experiment, found.max_steps
        append_result(results_dir, name, run, checkpoint, found, seed, EPISODES, steps)
    return found


def main(words: list[str] | None = None) -> None:
    """Measure the policies and print their returns."""
    args = parser_of(__doc__).parse_intermixed_args(words)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    found_of: dict[str, list[Returns]] = {}
    try:
        for run, checkpoint in find_targets(args.what, args.runs_dir):
            found = measure_and_keep(
                run,
                checkpoint,
                args.results_dir if args.write else None,
                args.evaluation_seed,
                args.threads,
                tuple(word for word in args.what if "=" in word),
            )
            found_of.setdefault(run.experiment, []).append(found)
    except UserError as error:
        sys.exit(f"error: {error}")
    for experiment, group in found_of.items():
        if len(group) > 1:
            median = statistics.median(found.episode_return for found in group)
            print(f"{experiment}, median of {len(group)}: return {median:.2f}")


if __name__ == "__main__":
    main()
