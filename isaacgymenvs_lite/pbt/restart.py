"""Restarts a training with changed settings, under the same process id."""

from __future__ import annotations

import logging
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from isaacgymenvs_lite.checkpoints.policy_arguments import as_override
from isaacgymenvs_lite.distributed import STARTS

log = logging.getLogger(__name__)

_TRAIN = ("-m", "isaacgymenvs_lite.train")


class RestartRequest(Exception):  # noqa: N818  This exception leaves rl_games' loop; no error.
    """Ends a training that continues with other settings in a new process.

    When this exception is raised, `runner.train` closes the task, the log and the folders, and
    train.py calls `start_again`. A program that has called `runner.run` must compose the tree again
    with `overrides`. `settings` maps paths in the tree to values.
    """

    def __init__(self, settings: Mapping[str, str | float | bool], run: Path) -> None:
        super().__init__("the training goes on with other settings: compose them and run again")
        self.settings = dict(settings)
        self._run = run

    @property
    def content(self) -> dict[str, Any]:
        """The request as JSON values, which other processes of the policy's training receive."""
        return {"settings": self.settings, "run": str(self._run)}

    @classmethod
    def of(cls, content: dict[str, Any] | None) -> RestartRequest | None:
        """Return the request with this content, or None if the content is None."""
        return None if content is None else cls(content["settings"], Path(content["run"]))

    @property
    def overrides(self) -> list[str]:
        """The settings as overrides for the command line."""
        return [
            # The command line is searched for `checkpoint=`, which must therefore have no `++`.
            f"{'' if path == 'checkpoint' else '++'}{path}={as_override(value)}"
            for path, value in self.settings.items()
        ]

    def words(self, typed: Sequence[str]) -> list[str]:
        """Replace these settings in the user's command-line arguments; return all arguments."""
        kept = [word for word in typed if word.partition("=")[0].lstrip("+") not in self.settings]
        kept = [f"resume={self._run}" if word.startswith("resume=") else word for word in kept]
        return [*kept, *self.overrides]


def start_again(request: RestartRequest, typed: Sequence[str]) -> NoReturn:
    """Replace this process by the user's command `typed` with the settings of a request.

    The process id and the environment stay, so that torchrun still knows the process. The operating
    system closes open files and releases locks, because Python opens files close-on-exec.
    """
    own = sys.orig_argv[1:]
    end = len(own) - len(typed)
    is_typed = end > 0 and own[end:] == list(typed)  # False if a user's program set sys.argv
    command = [sys.executable, *(own[:end] if is_typed else _TRAIN), *request.words(typed)]
    log.debug("restart: %s", shlex.join(command))
    os.environ[STARTS] = str(int(os.environ.get(STARTS) or 0) + 1)
    for handler in logging.getLogger().handlers:
        handler.flush()
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(command[0], command)
