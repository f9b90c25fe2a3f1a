"""Lists the shipped policies, and packs new ones: isaacgymenvs-lite policies COMMAND.

    isaacgymenvs-lite policies list
    isaacgymenvs-lite policies pack checkpoint=FILE name=NAME [clip=CLIP]

`checkpoint` is a file of a run (runs/<run>/nn/*.pth), or `last`, which means the newest checkpoint.
The packed policy is written to assets/policies or to out=FOLDER. Its name is enough to play it:

    python train.py test=True checkpoint=NAME
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from isaacgymenvs_lite.checkpoints.files import resolve_checkpoint
from isaacgymenvs_lite.checkpoints.packed import pack_policy, shipped_policy_infos
from isaacgymenvs_lite.command_line import run_command
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.schema import setting


@dataclass(frozen=True, kw_only=True)
class PackSettings:
    """Arguments of `pack`."""

    checkpoint: str = setting()
    """A .pth file in the folder nn/ of a run, or `last`."""
    name: str = setting()
    """Name of the policy."""
    clip: str = setting("")
    """The shipped clip that the policy imitates; '' selects the clip in the run's settings."""
    out: str = setting("")
    """Folder that receives the packed policy; '' selects assets/policies."""
    task: str = setting("HumanoidAMP")
    """Task whose newest checkpoint `last` selects."""
    runs: str = setting("runs")
    """Folder of all runs, in which `last` finds the newest checkpoint."""


@dataclass(frozen=True, kw_only=True)
class ListSettings:
    """Arguments of `list`, which has none."""


def show(_: ListSettings) -> None:
    """Write one line for each shipped policy."""
    for name, info in shipped_policy_infos().items():
        sys.stdout.write(f"{name:20}{info}\n")


def pack(settings: PackSettings) -> None:
    """Pack a checkpoint.

    Raises:
        UserError: the checkpoint cannot be packed.
    """
    checkpoint = resolve_checkpoint(settings.checkpoint, settings.runs, settings.task)
    if not checkpoint:
        raise ConfigError("checkpoint= is empty; expected a .pth file of a run, or 'last'")
    pack_policy(Path(checkpoint), settings.name, settings.clip, settings.out or None)


_COMMANDS = {"list": (ListSettings, show), "pack": (PackSettings, pack)}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="isaacgymenvs-lite policies", description=__doc__)
    parser.add_argument("command", choices=_COMMANDS)
    words = sys.argv[1:] if arguments is None else arguments
    settings, action = _COMMANDS.get(words[0] if words else "", _COMMANDS["pack"])
    return run_command(parser, settings, action, words)


if __name__ == "__main__":
    sys.exit(main())
