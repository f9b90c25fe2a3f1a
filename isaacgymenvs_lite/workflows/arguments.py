"""The command lines of the workflows."""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Callable, Sequence
from typing import Any

from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.optional_packages import require
from isaacgymenvs_lite.workflows.agent_files import PREFIX
from isaacgymenvs_lite.workflows.library import Library

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130


def make_parser(library: Library, verb: str) -> argparse.ArgumentParser:
    """Return a parser with what training and playing have in common."""
    parser = argparse.ArgumentParser(
        prog=library.command(verb),
        description=f"{verb.capitalize()}s an agent of {library.title}.",
    )
    parser.add_argument("--task", required=True, help="name of a task file, or its path")
    parser.add_argument("--num_envs", type=_positive, help="default: the task file's")
    headless = "no window: the default, headless=False opens one"
    parser.add_argument("--headless", action="store_true", help=headless)
    parser.add_argument("--seed", type=int, default=42, help="-1 draws one")
    parser.add_argument("--agent", help="an agent file, or its name; default: the task's")
    parser.add_argument("--logs", default="logs", help="folder of all trainings; default: logs")
    parser.add_argument("--video", action="store_true", help="film the first environment")
    parser.add_argument("--video_length", type=_positive, default=200, help="control steps")
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="key=value",
        help=f"of the task as on train.py's command line; {PREFIX}key=value of the agent file",
    )
    return parser


def add_number(parser: argparse.ArgumentParser, name: str, help_text: str, default: Any) -> None:
    """Add an option that takes a whole number above zero."""
    parser.add_argument(name, type=_positive, default=default, help=help_text)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}: expected a whole number >= 1")
    return value


def run_workflow(
    library: Library,
    parser: argparse.ArgumentParser,
    action: Callable[[argparse.Namespace], None],
    arguments: Sequence[str] | None,
) -> int:
    """Parse the command line and act; a user's mistake is one line and exit code 2.

    Args:
        library: must be installed.
        parser: of the command line.
        action: what to do with what it gives.
        arguments: without the program's name; None = `sys.argv`.

    Returns:
        The exit code.
    """
    # rsl_rl imports GitPython, which fails to be imported where there is no git.
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    args = parser.parse_intermixed_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        require(library.package, parser.prog)
        action(args)
    except UserError as error:
        parser.exit(EXIT_USER_ERROR, f"error: {error}\n")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return 0
