"""Trains or plays an agent of sb3, skrl or rsl_rl: isaacgymenvs-lite workflows sb3 train.

    isaacgymenvs-lite workflows sb3 train task=Cartpole num_envs=64
    isaacgymenvs-lite workflows sb3 play task=Cartpole

`isaacgymenvs-lite workflows sb3 train --help` lists the keys.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from isaacgymenvs_lite.errors import unknown
from isaacgymenvs_lite.workflows.command import EXIT_USER_ERROR
from isaacgymenvs_lite.workflows.rsl_rl import LIBRARY as RSL_RL
from isaacgymenvs_lite.workflows.sb3 import LIBRARY as SB3
from isaacgymenvs_lite.workflows.skrl import LIBRARY as SKRL
from isaacgymenvs_lite.workflows.training import play, train

LIBRARIES = {library.name: library for library in (SB3, SKRL, RSL_RL)}
VERBS = {"train": train, "play": play}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the verb for the library that the command line names; return the exit code."""
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
    library, verb = words[0], words[1] if len(words) > 1 else ""
    for what, given, choices in (("library", library, LIBRARIES), ("verb", verb, VERBS)):
        if given not in choices:
            parser.exit(EXIT_USER_ERROR, f"error: {unknown(what, given, choices)}\n")
    return VERBS[verb](LIBRARIES[library], words[2:])


if __name__ == "__main__":
    sys.exit(main())
