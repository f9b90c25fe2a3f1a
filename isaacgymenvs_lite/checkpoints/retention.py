"""Removes old periodic checkpoints, so that a long training does not fill the disk."""

from __future__ import annotations

import contextlib
from pathlib import Path


class Retention:
    """Keeps the checkpoints of the last epochs in which periodic ones were written.

    Only files that were passed to `written` are ever removed: none of an earlier start or of
    another program, and not the best checkpoint, which has one name for the whole run.

    Args:
        keep: epochs whose files stay; 0: all.
    """

    def __init__(self, keep: int) -> None:
        self._keep = keep
        self._files: dict[int, set[Path]] = {}

    def written(self, file: Path, epoch: int) -> None:
        """Note a file that was written, and remove those that are too old.

        Args:
            file: the checkpoint, or where it was rescued to.
            epoch: of the training, from 1.
        """
        if self._keep == 0:
            return
        self._files.setdefault(epoch, set()).add(file)
        for old in sorted(self._files)[: -self._keep]:
            for path in self._files.pop(old):
                with contextlib.suppress(OSError):
                    path.unlink()
