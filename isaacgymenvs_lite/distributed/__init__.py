"""Trains one policy in several processes, on CPUs or GPUs, on one machine or many.

torchrun restarts all processes with the same command if a process fails (`--max-restarts`). The run
folder contains the name of torchrun's job, by which the restarted processes find their run.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

STARTS = "ISAACGYMENVS_LITE_STARTS"
"""Environment variable that counts how often a process has replaced itself (`pbt.restart`)."""
_FILE = "torchrun_job"
_MAX_BYTES = 1000


def started_by_torchrun() -> bool:
    """Return whether torchrun started this process."""
    return int(os.environ.get("WORLD_SIZE") or 1) > 1


def mark_run(run: Path) -> None:
    """Write the name of torchrun's job into a run folder."""
    if job := _job():
        (run / _FILE).write_text(job, encoding="utf-8")


def words_after_restart(words: Sequence[str], runs: Iterable[Path]) -> list[str] | None:
    """Return the command line that resumes this job's run, or None if the job has no run yet.

    Args:
        words: arguments of the command line that torchrun repeats.
        runs: the run folders to search.
    """
    if os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") == "0" or not _job():
        return None
    found = [
        run
        for run in runs
        if _is_of_this_job(run) and (any(run.glob("resume/*.pth")) or any(run.glob("nn/*.pth")))
    ]
    if not found:
        return None
    kept = [word for word in words if word.startswith(("multi_gpu=", "distributed_timeout_s="))]
    return [f"resume={max(found, key=lambda run: run.stat().st_mtime)}", *kept]


def _job() -> str:
    """Return the name of torchrun's job, which is '' if the job has no name."""
    name = os.environ.get("TORCHELASTIC_RUN_ID", "")
    return "" if name == "none" else name


def _is_of_this_job(run: Path) -> bool:
    with contextlib.suppress(OSError), (run / _FILE).open("rb") as file:
        return file.read(_MAX_BYTES) == _job().encode()
    return False
