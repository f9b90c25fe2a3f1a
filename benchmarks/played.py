"""What the measurements of played policies share: which checkpoints, and a line of results."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.machine import describe_machine
from benchmarks.protocol import EPISODE_STEPS
from benchmarks.runs import Run, find_runs
from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.errors import CheckpointError, ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def find_targets(words: Sequence[str], runs_dir: Path) -> list[tuple[Run, Path]]:
    """Return runs and checkpoints for the words that are no overrides.

    Args:
        words: checkpoints, run folders, experiments (the newest checkpoint of each seed), and
            `key=value`.
        runs_dir: where the runs of experiments are.

    Raises:
        UserError: a word means nothing, or a run has no checkpoint.
    """
    found = []
    for word in words:
        if "=" in word:
            continue
        if word.endswith(".pth"):
            found.append((Run.at(Path(word).absolute().parent.parent), Path(word)))
            continue
        for run in find_runs(word, runs_dir):
            checkpoint = run.newest_checkpoint()
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
    """Add a line to `<name>.jsonl`: what was found, and of what."""
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
