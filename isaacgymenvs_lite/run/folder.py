"""Makes and finds run folders: `<train_dir>/<run name>/` with config.yaml, nn/, summaries/."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.run_names import MAX_LEVELS
from isaacgymenvs_lite.errors import ConfigError


class RunFolder:
    """The folder of one training run.

    It is made before anything long starts, and removed if a mistake ends the run at once.

    Args:
        train_dir: folder of all runs.
        run_name: name of this one; rl_games gets the same name and writes into the same folder.

    Attributes:
        name: of the run.
        path: of the folder.
        checkpoints: path of its folder of checkpoints.
    """

    def __init__(self, train_dir: Path, run_name: str) -> None:
        self.train_dir = train_dir
        self.name = run_name
        self.path = train_dir / run_name
        self.checkpoints = self.path / "nn"
        self._was_there = True

    def create(self, cfg: DictConfig) -> None:
        """Make the folders and write the composed tree with its interpolations unresolved.

        Raises:
            ConfigError: the folder cannot be written, or is part of another run.
        """
        for folder in self.path.relative_to(self.train_dir).parents:
            if folder.parts and (self.train_dir / folder / "config.yaml").exists():
                raise ConfigError(
                    f"{self.path} lies in the folder of another run, {self.train_dir / folder};"
                    " choose another experiment=NAME"
                )
        self._was_there = self.path.exists()
        try:
            self.checkpoints.mkdir(parents=True, exist_ok=True)
            (self.path / "summaries").mkdir(exist_ok=True)
            config = self.path / "config.yaml"
            config.write_text(OmegaConf.to_yaml(cfg), encoding="utf-8")
        except OSError as error:
            self.remove_if_unused()
            raise ConfigError(
                f"cannot write the run folder {self.path.absolute()}"
                f" ({error.strerror or error}); choose another with"
                " +train.params.config.train_dir=FOLDER"
            ) from error

    def remove_if_unused(self) -> None:
        """Remove what `create` made if there is no checkpoint; never a folder from before."""
        if not self._was_there and self.newest_checkpoint() is None:
            shutil.rmtree(self.path, ignore_errors=True)

    def newest_checkpoint(self) -> Path | None:
        """Return the checkpoint that was written last, None without one."""
        files = self.checkpoints.glob("*.pth")
        return max(files, key=lambda file: file.stat().st_mtime, default=None)


def run_folders(train_dir: Path) -> Iterator[Path]:
    """Yield the run folders at any depth below `train_dir`: those with a config.yaml."""
    for folder, below, files in os.walk(train_dir, followlinks=True):
        if "config.yaml" in files and Path(folder) != train_dir:
            below.clear()
            yield Path(folder)
        elif len(Path(folder).relative_to(train_dir).parts) >= MAX_LEVELS:
            below.clear()


def run_of_checkpoint(checkpoint: str) -> Path | None:
    """Return the run folder that a checkpoint lies in, `<run>/nn/<name>.pth`; None elsewhere."""
    path = Path(checkpoint)
    return path.parent.parent if checkpoint and path.parent.name == "nn" else None
