"""Writes recordings of diverged simulations into the run folder, for `simulation.replay`."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation.recording import write_recording
from isaacgymenvs_lite.typed_command import package_command

log = logging.getLogger(__name__)

_FOLDER = "diverged"
_MAX_FILES = 20


class DivergenceFiles:
    """A task's listener that writes at most 20 files `<run>/diverged/0001.npz`, `0002.npz`, ...

    A process whose rank is not 0 adds the rank to the names: `0001_rank1.npz`.
    """

    def __init__(self, task: Any, run_folder: Path, rank: int = 0) -> None:
        self._recordings = task.simulation.recordings
        self._task_name = str(task.cfg.get("name", ""))
        self._folder = run_folder / _FOLDER
        self._ending = f"_rank{rank}.npz" if rank > 0 else ".npz"
        self._written = len(list(self._folder.glob("[0-9]" * 4 + self._ending)))
        self._has_reported = False

    def after_step(self) -> None:
        """Write the recordings of the step."""
        while self._recordings and self._written < _MAX_FILES:
            recording = replace(self._recordings.pop(0), task=self._task_name)
            path = self._folder / f"{self._written + 1:04}{self._ending}"
            try:
                write_recording(path, recording)
            except ConfigError as error:
                log.warning("%s; diverged simulations are not recorded any more", error)
                self._written = _MAX_FILES
                return
            self._written += 1
            if not self._has_reported:
                self._has_reported = True
                show = package_command("replay", str(path))
                log.warning("a simulation diverged; '%s' shows how", show)

    def render(self) -> None:
        """Do nothing, because this listener shows nothing."""

    def close(self) -> None:
        """Do nothing, because this listener holds no resources."""
