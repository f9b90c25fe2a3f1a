"""Lists the commands of this package: python -m isaacgymenvs_lite."""

from __future__ import annotations

import argparse
import ast
import sys
from pathlib import Path

from isaacgymenvs_lite import __version__
from isaacgymenvs_lite.command_line import EXIT_USER_ERROR
from isaacgymenvs_lite.errors import unknown

PACKAGE = "isaacgymenvs_lite"
COMMANDS = (
    *("train", "check", "demo", "report", "export", "policies", "workflows", "alias"),
    *(
        "motion.robot",
        "motion.view",
        "motion.plot",
        "motion.strip",
        "motion.convert",
        "motion.gait",
        "simulation.replay",
    ),
)
"""Modules that `python -m` runs, in the order in which a user meets them."""
DOORS = tuple(
    f"workflows.{library}.{verb}"
    for library in ("sb3", "skrl", "rsl_rl")
    for verb in ("train", "play")
)
"""Modules of Isaac Lab's form; each is one use of the command `workflows`, and not listed."""


def main(arguments: list[str] | None = None) -> int:
    """Print the list; return the exit code."""
    prog = f"python -m {PACKAGE}"
    parser = argparse.ArgumentParser(prog=prog, description=(__doc__ or "").partition(":")[0] + ".")
    parser.add_argument("words", nargs="*", help=argparse.SUPPRESS)
    words = parser.parse_args(arguments).words
    if not words:
        sys.stdout.write(overview())
        return 0
    if words[0] in (*COMMANDS, *DOORS):
        hint = f"'{words[0]}' is a module: {prog}.{' '.join(words)}"
    else:
        hint = unknown("command", words[0], COMMANDS)
    parser.exit(EXIT_USER_ERROR, f"error: {hint}\n")


def overview() -> str:
    """Return every command with a line that says what it does."""
    lines = [
        f"isaacgymenvs_lite {__version__}: python -m {PACKAGE}.<command>, with --help for more",
        "",
        *(f"    {command:24}{purpose(command)}" for command in COMMANDS),
        "",
        f"In a checkout, python train.py is python -m {PACKAGE}.train.",
    ]
    return "\n".join([*lines, ""])


def purpose(command: str) -> str:
    """Return the first sentence of a command's module, without importing it."""
    path = Path(__file__).parent.joinpath(*command.split("."))
    file = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0].partition(": python ")[0].rstrip(".")


if __name__ == "__main__":
    sys.exit(main())
