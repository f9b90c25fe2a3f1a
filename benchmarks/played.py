"""Shares command line, checkpoints and results between the benchmarks that play policies."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.machine import describe_machine
from benchmarks.protocol import EPISODE_STEPS, SEED
from benchmarks.runs import DEFAULT_RUNS_DIR, Run, find_runs
from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.errors import CheckpointError, ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


RESULTS_DIR = Path(__file__).with_name("results")


def parser_of(module_docstring: str | None, kinds: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return a parser with the common arguments, and with the first argument `kind` for kinds."""
    parser = argparse.ArgumentParser(description=(module_docstring or "").partition("\n")[0])
    if kinds:
        parser.add_argument("kind", choices=kinds)
    parser.add_argument("what", nargs="+", help="checkpoints, run folders, experiments, overrides")
    parser.add_argument("--runs-dir", type=Path, default=DEFAULT_RUNS_DIR)
    parser.add_argument("--evaluation-seed", type=int, default=SEED)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="add the results to --results-dir")
    parser.add_argument("--results-dir", type=Path, default=RESULTS_DIR)
    return parser


def find_targets(
    words: Sequence[str], runs_dir: Path, epoch: int | None = None
) -> list[tuple[Run, Path]]:
    """Return the runs and checkpoints that the command line names.

    Args:
        words: checkpoints, run folders and experiments; overrides `key=value` are skipped.
        runs_dir: folder of the experiments' runs.
        epoch: epoch of the checkpoint in each run; None selects the newest checkpoint.

    Raises:
        UserError: there is no such run, or a run has no such checkpoint.
    """
    found = []
    for word in words:
        if "=" in word:
            continue
        if word.endswith(".pth"):
            found.append((Run.at(Path(word).absolute().parent.parent), Path(word)))
            continue
        for run in find_runs(word, runs_dir):
            newest = run.newest_checkpoint()
            checkpoint = newest if epoch is None else run.checkpoint_of_epoch(epoch)
            if checkpoint is None:
                raise CheckpointError(f"{run.folder}: no checkpoint in nn/")
            found.append((run, checkpoint))
    if not found:
        raise ConfigError("give a checkpoint, a run folder or an experiment")
    return found


def append_result(
    folder: Path,
    name: str,
    run: Run,
    checkpoint: Path,
    found: DataclassInstance,
    evaluation_seed: int,
    episodes: int,
    episode_steps: int = EPISODE_STEPS,
) -> None:
    """Append the result `found` of a checkpoint to `<folder>/<name>.jsonl` as one line."""
    starts = run.starts()
    row: dict[str, Any] = {
        "experiment": name,
        "seed": run.seed,
        "checkpoint": checkpoint.name,
        "frames": int(load_checkpoint(checkpoint).get("frame", 0)),
        **asdict(found),
        "evaluation_seed": evaluation_seed,
        "num_episodes": episodes,
        "episode_steps": episode_steps,
        "machine": starts[-1].machine if starts else describe_machine(),
        "commit": ", ".join(dict.fromkeys(start.commit for start in starts)) or None,
        "settings": starts[-1].settings if starts else None,
    }
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{name}.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(row, allow_nan=False) + "\n")
