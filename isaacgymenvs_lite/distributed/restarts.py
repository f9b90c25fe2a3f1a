"""A training that torchrun restarts (`--max-restarts`) goes on with its run folder.

torchrun starts all processes again, with the same command, when one has failed. The run folder has
a file with the name of torchrun's job, by which the new processes find it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

_FILE = "torchrun_job"
_MAX_BYTES = 1000


def mark_run(run: Path) -> None:
    """Write the name of torchrun's job into a run folder."""
    if job := _job():
        (run / _FILE).write_text(job, encoding="utf-8")


def words_after_restart(words: Sequence[str], runs: Iterable[Path]) -> list[str] | None:
    """Return the command line that goes on with the run of this job; None if there is none yet.

    Args:
        words: the command line that torchrun repeats.
        runs: the run folders to search.
    """
    if os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") == "0" or not _job():
        return None
    found = [run for run in runs if _is_of_this_job(run) and _has_checkpoint(run)]
    if not found:
        return None
    kept = [word for word in words if word.startswith(("multi_gpu=", "distributed_timeout_s="))]
    return [f"resume={max(found, key=lambda run: run.stat().st_mtime)}", *kept]


def _job() -> str:
    """Return the name of torchrun's job; '' if it has none of its own."""
    name = os.environ.get("TORCHELASTIC_RUN_ID", "")
    return "" if name == "none" else name


def _is_of_this_job(run: Path) -> bool:
    with contextlib.suppress(OSError), (run / _FILE).open("rb") as file:
        return file.read(_MAX_BYTES) == _job().encode()
    return False


def _has_checkpoint(run: Path) -> bool:
    return any(next(run.glob(f"{folder}/*.pth"), None) for folder in ("resume", "nn"))
