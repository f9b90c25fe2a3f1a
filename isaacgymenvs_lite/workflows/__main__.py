"""Trains or plays an agent of sb3, skrl or rsl_rl: isaacgymenvs-lite workflows sb3 train.

    isaacgymenvs-lite workflows sb3 train task=Cartpole num_envs=64
    isaacgymenvs-lite workflows sb3 play task=Cartpole

`isaacgymenvs-lite workflows sb3 train --help` lists the keys.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from isaacgymenvs_lite.command_line import log_messages
from isaacgymenvs_lite.errors import EXIT_INTERRUPTED, EXIT_USER_ERROR, UserError, unknown
from isaacgymenvs_lite.utils.optional_packages import require
from isaacgymenvs_lite.workflows.command import (
    PlaySettings,
    TrainSettings,
    log_idle_options,
    make_parser,
    read_command,
)
from isaacgymenvs_lite.workflows.library import LIBRARIES
from isaacgymenvs_lite.workflows.training import play, train

VERBS = ("train", "play")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the verb for the library that the command line names; return the exit code.

    A user's mistake is one line and exit code 2.

    Args:
        arguments: without the program's name; None = `sys.argv`.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(
        prog="isaacgymenvs-lite workflows",
        usage=f"%(prog)s {'|'.join(LIBRARIES)} {'|'.join(VERBS)} task=<name> [key=value ...]",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if not words or {"-h", "--help"} & set(words[:2]):
        parser.print_help()
        return 0
    name, verb = words[0], words[1] if len(words) > 1 else ""
    for what, given, choices in (("library", name, LIBRARIES), ("verb", verb, VERBS)):
        if given not in choices:
            parser.exit(EXIT_USER_ERROR, f"error: {unknown(what, given, choices)}\n")
    library = LIBRARIES[name]
    # rsl_rl imports GitPython, whose import fails where there is no git.
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    parser = make_parser(library, verb)
    args = parser.parse_intermixed_args(words[2:])
    log_messages()
    try:
        require(library.package, parser.prog)
        log_idle_options(args)
        if verb == "train":
            train(library, read_command(TrainSettings, args))
        else:
            play(library, read_command(PlaySettings, args))
    except UserError as error:
        parser.exit(EXIT_USER_ERROR, f"error: {error}\n")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
