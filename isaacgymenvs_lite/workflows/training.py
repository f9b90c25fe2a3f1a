"""Training an agent of any library: task, agent, folder, videos."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path

from isaacgymenvs_lite.run.stop_request import signals_as_ctrl_c
from isaacgymenvs_lite.workflows.agent_files import load_agent_file, seed_of
from isaacgymenvs_lite.workflows.arguments import (
    add_number,
    make_parser,
    run_workflow,
)
from isaacgymenvs_lite.workflows.checkpoint_files import read_parameters
from isaacgymenvs_lite.workflows.library import Library
from isaacgymenvs_lite.workflows.log_folder import create_folder
from isaacgymenvs_lite.workflows.task_from_args import agent_words, make_task

log = logging.getLogger(__name__)


def train(library: Library, arguments: Sequence[str] | None = None) -> int:
    """Train as the command line says; returns the exit code.

    Args:
        library: whose agent.
        arguments: without the program's name; None = `sys.argv`.
    """
    parser = make_parser(library, "train")
    add_number(parser, "--max_iterations", "default: the agent file's", None)
    add_number(parser, "--video_interval", "control steps from one to the next", 2000)
    add_number(parser, "--log_interval", "frames from one log entry to the next", None)
    parser.add_argument("--checkpoint", help="a file to go on from")
    return run_workflow(library, parser, lambda args: _train(library, args), arguments)


def _train(library: Library, args: argparse.Namespace) -> None:
    if args.checkpoint is not None:
        read_parameters(Path(args.checkpoint), library)  # a mistake shows before anything is made
    name = Path(args.task).stem
    content = load_agent_file(library.name, name, args.agent, agent_words(args))
    made = make_task(args, seed_of(content), plays=False)
    try:
        if args.max_iterations is not None:
            content["max_iterations"] = args.max_iterations
        agent = library.make_agent(made.task, content, made.rl_device, made.seed)
        made.fit_threads(agent.minibatch_rows, agent.num_parameters)
        if args.checkpoint is not None:
            agent.load(Path(args.checkpoint))
        folder = create_folder(Path(args.logs), library, name, made.settings, content)
        log.info("log folder: %s", folder)
        made.watch(folder)
        try:
            with signals_as_ctrl_c():
                agent.learn(folder, args.log_interval)
        except KeyboardInterrupt:
            log.info("stopped; saved %s", agent.save(folder))
            raise
    finally:
        made.close()
