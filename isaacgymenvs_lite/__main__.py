"""Runs the commands of this package: isaacgymenvs-lite COMMAND [ARGUMENTS]."""

from __future__ import annotations

import ast
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

from isaacgymenvs_lite import __version__
from isaacgymenvs_lite.errors import EXIT_USER_ERROR, UserError, unknown
from isaacgymenvs_lite.paths import check_working_folder
from isaacgymenvs_lite.typed_command import CONSOLE_SCRIPT, PACKAGE

COMMANDS = {
    "train": "train",
    "play": "train",
    "demo": "commands.demo",
    "check": "commands.check",
    "convert": "motion.convert",
    "view": "motion.view",
    "plot": "motion.plot",
    "strip": "motion.strip",
    "gait": "motion.gait",
    "robot": "motion.robot",
    "export": "export",
    "report": "report",
    "replay": "simulation.replay",
    "policies": "commands.policies",
    "workflows": "workflows",
    "alias": "commands.alias",
}
"""Maps each command to its module, in the order in which users need the commands."""
PLAY = "Plays a policy: checkpoint=last, a file, or the name of a shipped policy"
DOORS = tuple(
    f"workflows.{library}.{verb}"
    for library in ("sb3", "skrl", "rsl_rl")
    for verb in ("train", "play")
)
"""Scripts that have the names of Isaac Lab's scripts. --help omits these scripts, because
`workflows` does the same."""
_HELP = ("-h", "--help", "help")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, or print the list of commands; return the exit code.

    The command's module runs as the main program, as with `python -m`, and may end the process.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in _HELP:
        sys.stdout.write(overview())
        return 0
    if words[0] == "--version":
        sys.stdout.write(f"{PACKAGE} {__version__}\n")
        return 0
    command, *words = words
    if command == "play":
        words = words_of_play(words)
    module = COMMANDS.get(command, command)
    if module not in (*COMMANDS.values(), *DOORS):
        sys.stderr.write(f"error: {unknown('command', command, COMMANDS)}\n")
        return EXIT_USER_ERROR
    try:
        check_working_folder()
    except UserError as error:
        sys.stderr.write(f"error: {error}\n")
        return EXIT_USER_ERROR
    sys.argv[1:] = words
    runpy.run_module(f"{PACKAGE}.{module}", run_name="__main__", alter_sys=True)
    return 0


def words_of_play(words: Sequence[str]) -> list[str]:
    """Return the arguments of `train` that play a policy, by default the newest policy."""
    asks_for_help = any(word in _HELP for word in words)
    named = any(word.startswith("checkpoint=") for word in words)
    checkpoint = [] if named or asks_for_help else ["checkpoint=last"]
    return ["test=True", *checkpoint, *words]


def overview() -> str:
    """Return a text with a line for each command."""
    lines = [
        f"isaacgymenvs_lite {__version__}: {CONSOLE_SCRIPT} COMMAND, with --help for more",
        "",
        *(f"    {command:12}{purpose(command)}" for command in COMMANDS),
        "",
        f"The same: python -m {PACKAGE} COMMAND. In a checkout: python train.py for train.",
    ]
    return "\n".join([*lines, ""])


def purpose(command: str) -> str:
    """Return the first sentence of a command's module, without importing it."""
    if command == "play":
        return PLAY
    path = Path(__file__).parent.joinpath(*COMMANDS[command].split("."))
    file = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0].partition(": python ")[0].rstrip(".")


if __name__ == "__main__":
    sys.exit(main())
