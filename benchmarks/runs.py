"""Finds run folders of benchmarks, `<runs_dir>/<experiment>_seed<n>`, and logs their starts."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.run.folder import RunFolder

ROOT = Path(__file__).resolve().parents[1]
DEFAULT_RUNS_DIR = Path("runs/benchmarks")
_STARTS_FILE = "benchmark.jsonl"
_CLIP = "task.env.motion_file"


@dataclass(frozen=True)
class Start:
    """One start of train.py in a run folder.

    Attributes:
        settings: the experiment's overrides.
        command: the command line.
        cores: CPUs of the process.
        machine: see `describe_machine`.
        commit: commit of the source tree, with the suffix "-dirty" if files were changed.
        started_at: local time, ISO 8601.
    """

    settings: list[str]
    command: str
    cores: list[int]
    machine: str
    commit: str
    started_at: str


@dataclass(frozen=True)
class Run:
    """A training of one seed."""

    experiment: str
    seed: int
    folder: Path

    @classmethod
    def of(cls, runs_dir: Path, experiment: str, seed: int) -> Run:
        """Return the run of an experiment's seed; the folder may be missing."""
        return cls(experiment, seed, runs_dir / f"{experiment}_seed{seed}")

    @classmethod
    def at(cls, folder: Path) -> Run:
        """Return the run in a folder of train.py, which may have any name.

        Raises:
            CheckpointError: there is no config.yaml.
        """
        name = folder.resolve().name
        if (folder / "config.yaml").is_file():
            cfg = read_yaml(folder / "config.yaml")
            return cls(re.sub(r"_seed\d+$", "", name), int(OmegaConf.select(cfg, "seed")), folder)
        raise CheckpointError(
            f"{folder}: no run folder; expected a folder with config.yaml and nn/"
        )

    @property
    def label(self) -> str:
        """The name in messages."""
        return f"{self.experiment} seed {self.seed}"

    def newest_checkpoint(self) -> Path | None:
        """Return the last written checkpoint, None if there is no checkpoint."""
        return RunFolder(self.folder.parent, self.folder.name).newest_checkpoint()

    def has_motions(self) -> bool:
        """Return whether the task has reference motions."""
        return OmegaConf.select(read_yaml(self.folder / "config.yaml"), _CLIP) is not None

    def checkpoint_of_epoch(self, epoch: int) -> Path:
        """Return the checkpoint of an epoch.

        Raises:
            CheckpointError: there is no checkpoint of this epoch.
        """
        found = sorted(self.folder.glob(f"nn/last_*_ep_{epoch}_rew_*.pth"))
        if not found:
            raise CheckpointError(f"{self.folder}: no checkpoint of epoch {epoch} in nn/")
        return found[-1]

    def starts(self) -> list[Start]:
        """Return the noted starts in the order of time."""
        file = self.folder / _STARTS_FILE
        lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
        return [Start(**json.loads(line)) for line in lines]

    def note_start(self, start: Start) -> None:
        """Append a start to the log in the folder, and make the folder if it is missing."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / _STARTS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(start)) + "\n")


def start_now(settings: Sequence[str], command: str, cores: Sequence[int]) -> Start:
    """Return a start with the current time, machine and commit ("unknown" outside a checkout)."""
    result = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"],
        cwd=ROOT,
        env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"},
        capture_output=True,
        text=True,
        check=False,
    )
    commit = result.stdout.strip() or "unknown"
    now = datetime.now().isoformat(timespec="seconds")
    return Start(list(settings), command, list(cores), describe_machine(), commit, now)


def find_runs(target: str, runs_dir: Path) -> list[Run]:
    """Return the runs of a target, sorted by seed.

    Args:
        target: a run folder, or the name of an experiment for all its seeds in `runs_dir`.
        runs_dir: folder of the run folders.

    Raises:
        CheckpointError: there is no such run.
    """
    if Path(target).is_dir():
        return [Run.at(Path(target))]
    runs = [
        Run(target, int(seed[1]), folder)
        for folder in runs_dir.glob("*")
        if (seed := re.fullmatch(re.escape(target) + r"_seed(\d+)", folder.name))
    ]
    if not runs:
        present = ", ".join(sorted(folder.name for folder in runs_dir.glob("*"))) or "nothing"
        raise CheckpointError(
            f"'{target}': neither a run folder nor an experiment with runs in {runs_dir}"
            f" (found: {present}); train it with python -m benchmarks.learning, or give --runs-dir"
        )
    return sorted(runs, key=lambda run: run.seed)


def plain(value: Any) -> Any:
    """Return a value for JSON: None in place of infinity and nan."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
