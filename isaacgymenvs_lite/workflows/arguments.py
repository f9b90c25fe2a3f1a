"""The command lines of the workflows, which take what Isaac Lab's scripts take."""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from isaacgymenvs_lite.errors import UserError, suggest
from isaacgymenvs_lite.gymnasium_ids import task_of_id
from isaacgymenvs_lite.utils.optional_packages import require
from isaacgymenvs_lite.workflows.agent_files import PREFIX
from isaacgymenvs_lite.workflows.library import Library

log = logging.getLogger(__name__)

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130

# Options of Isaac Lab's launcher and scripts. Those without a value, and those with one, that
# there is nothing to do for: pictures need no switch, infos hold all there is, and there is no Kit.
_IDLE_FLAGS = (
    *("enable_cameras", "keep_all_info", "disable_fabric", "export_io_descriptors"),
    *("verbose", "info"),
)
_IDLE_VALUES = ("kit_args", "experience", "rendering_mode")
# Those that ask for something that is found elsewhere, and where.
_ELSEWHERE = {
    "distributed": "a training is one process, on all CPUs or one GPU; leave it out",
    "multi_gpu": "a training is one process, on all CPUs or one GPU; leave it out",
    "xr": "there is no headset's view; use viewer=web",
    "viz": "use headless=False for a window, viewer=web for a page in the browser",
    "visualizer": "use headless=False for a window, viewer=web for a page in the browser",
    "resume": "use --checkpoint FILE",
    "load_run": "use --checkpoint FILE",
    "run_name": "folders are named by task and date; use --logs FOLDER",
    "experiment_name": "folders are named by task and date; use --logs FOLDER",
    "logger": "TensorBoard's files are always written, nothing else; leave it out",
    "log_project_name": "TensorBoard's files are always written, nothing else; leave it out",
    "use_pretrained_checkpoint": "none are shipped for this library; use --checkpoint FILE",
}


class _Parser(argparse.ArgumentParser):
    """Says a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        words = message.split()
        if message.startswith("unrecognized arguments:"):
            known = [name for action in self._actions for name in action.option_strings]
            message += suggest(words[2].partition("=")[0], known)
        self.exit(EXIT_USER_ERROR, f"error: {message}; --help lists the options\n")


class _Elsewhere(argparse.Action):
    """Says what to use instead of an option."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        del namespace, values
        hint = _ELSEWHERE[self.dest]
        parser.exit(EXIT_USER_ERROR, f"error: {option_string}: {hint}\n")


def make_parser(library: Library, verb: str) -> argparse.ArgumentParser:
    """Return a parser with what training and playing have in common."""
    parser = _Parser(
        prog=library.command(verb),
        description=f"{verb.capitalize()}s an agent of {library.title}.",
        epilog="Other options of Isaac Lab's scripts are taken, or answered with what to use.",
    )
    parser.add_argument(
        "--task",
        required=True,
        type=task_of_id,
        help="name of a task file, its path, or a name of Gymnasium: IsaacGymEnvsLite/Ant-v0",
    )
    parser.add_argument("--num_envs", type=_positive, help="default: the task file's")
    headless = "no window: the default, headless=False opens one"
    parser.add_argument("--headless", action="store_true", help=headless)
    parser.add_argument(
        "--livestream", type=int, choices=(-1, 0, 1, 2), help="1, 2: a page, as viewer=web"
    )
    device = "of the networks: cpu, cuda or cuda:N; the physics is on the CPU"
    parser.add_argument("--device", help=device)
    parser.add_argument("--cpu", action="store_const", const="cpu", dest="device", help="the same")
    parser.add_argument("--seed", type=int, help="-1 draws one; default: the agent file's, or 42")
    parser.add_argument("--agent", help="an agent file, or its name; default: the task's")
    parser.add_argument("--logs", default="logs", help="folder of all trainings; default: logs")
    parser.add_argument("--video", action="store_true", help="film the first environment")
    parser.add_argument("--video_length", type=_positive, default=200, help="control steps")
    _add_isaac_lab_options(parser)
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="key=value",
        help=f"of the task as on train.py's command line; {PREFIX}key=value of the agent file",
    )
    return parser


def _add_isaac_lab_options(parser: argparse.ArgumentParser) -> None:
    hidden = argparse.SUPPRESS
    for name in _IDLE_FLAGS:
        parser.add_argument(f"--{name}", action="store_true", help=hidden)
    for name in _IDLE_VALUES:
        parser.add_argument(f"--{name}", help=hidden)
    for name in _ELSEWHERE:
        parser.add_argument(f"--{name}", action=_Elsewhere, nargs="?", help=hidden)
    # Of skrl's scripts: there is one choice.
    parser.add_argument("--ml_framework", choices=("torch",), help=hidden)
    parser.add_argument("--algorithm", type=str.upper, choices=("PPO",), help=hidden)


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
        _note_idle_options(args)
        action(args)
    except UserError as error:
        parser.exit(EXIT_USER_ERROR, f"error: {error}\n")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return 0


def _note_idle_options(args: argparse.Namespace) -> None:
    given = [f"--{name}" for name in (*_IDLE_FLAGS, *_IDLE_VALUES) if getattr(args, name)]
    if given:
        log.info("%s: nothing to do for it here", ", ".join(given))
