"""Measures policies of the classic tasks by their returns.

    python -m benchmarks.returns TARGET [TARGET ...] [key=value ...]
        [--runs-dir runs/benchmarks] [--write]

Targets are those of `benchmarks.evaluate`. 128 episodes, one in each environment, the same starts
for all policies; mean actions, no noise. The return is the sum of the task's rewards of an episode,
as the task pays them. `--write` adds the numbers to benchmarks/results.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.evaluate import RESULTS_DIR
from benchmarks.played import append_result, find_targets
from benchmarks.protocol import SEED, play_checkpoint
from benchmarks.runs import DEFAULT_RUNS_DIR, Run
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.evaluation.evaluate import evaluate

EPISODES = 128
_FIXED = {"num_envs": EPISODES, "task.env.numEnvs": EPISODES, "task.task.randomize": False}


@dataclass(frozen=True, kw_only=True)
class Returns:
    """What a policy reached, as means over the episodes.

    Attributes:
        episode_return: sum of the task's rewards.
        steps: control steps.
        max_steps: of an episode that nothing ends early.
    """

    episode_return: float
    steps: float
    max_steps: int

    def __str__(self) -> str:
        return f"return {self.episode_return:.2f}, {self.steps:.0f} of {self.max_steps} steps"


def measure_returns(player: Any, env: Any) -> Returns:
    """Play a policy; see the module docstring."""
    result = evaluate(env, player.act, EPISODES, on_step=getattr(player, "on_step", None))
    return Returns(
        episode_return=result.reward, steps=result.steps, max_steps=env.max_episode_length - 1
    )


def measure_and_keep(
    run: Run,
    checkpoint: Path,
    results_dir: Path | None,
    seed: int = SEED,
    num_threads: int = 1,
    overrides: tuple[str, ...] = (),
) -> Returns:
    """Play a checkpoint of a run and print what it reached.

    Args:
        run: that the checkpoint is of.
        checkpoint: in its folder nn/.
        results_dir: where a line and the learning curve are written; None: nowhere.
        seed: of the starts.
        num_threads: for physics and networks.
        overrides: settings that replace the run's.

    Raises:
        UserError: it cannot be played.
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
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", nargs="+", help="checkpoints, run folders, experiments, overrides")
    parser.add_argument("--runs-dir", type=Path, default=DEFAULT_RUNS_DIR)
    parser.add_argument("--evaluation-seed", type=int, default=SEED)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="add the numbers to --results-dir")
    parser.add_argument("--results-dir", type=Path, default=RESULTS_DIR)
    args = parser.parse_intermixed_args(words)
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
