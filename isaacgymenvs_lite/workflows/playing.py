"""Playing a trained agent of any library: one episode in each environment."""

from __future__ import annotations

import argparse
import contextlib
import logging
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from isaacgymenvs_lite.workflows.agent_files import load_agent_file, seed_of
from isaacgymenvs_lite.workflows.arguments import make_parser, run_workflow
from isaacgymenvs_lite.workflows.checkpoint_files import read_parameters
from isaacgymenvs_lite.workflows.library import Library
from isaacgymenvs_lite.workflows.log_folder import agent_file_of, date, folder_of, last_checkpoint
from isaacgymenvs_lite.workflows.task_from_args import agent_words, make_task
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Played:
    """The first episode of each environment.

    Attributes:
        returns: (N,) sums of rewards.
        lengths: (N,) control steps.
        truncated: (N,) bool, ended by the time limit.
    """

    returns: torch.Tensor
    lengths: torch.Tensor
    truncated: torch.Tensor

    def lines(self) -> list[str]:
        """Return what there is to say of them."""
        count = len(self.returns)
        returns, lengths = self.returns, self.lengths.double()
        return [
            f"episodes: {count}, {int(self.truncated.sum())} to the time limit",
            f"return: mean {returns.mean():.2f}, min {returns.min():.2f}, max {returns.max():.2f}",
            f"length: mean {lengths.mean():.1f}, min {lengths.min():.0f}, max {lengths.max():.0f}",
        ]


def play(library: Library, arguments: Sequence[str] | None = None) -> int:
    """Play as the command line says and tell returns and lengths; returns the exit code.

    Args:
        library: whose agent.
        arguments: without the program's name; None = `sys.argv`.
    """
    parser = make_parser(library, "play")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--checkpoint", help="a file; default: the newest of the task's trainings")
    which.add_argument("--use_last_checkpoint", action="store_true", help="the default")
    parser.add_argument("--real-time", action="store_true", help="wait where steps are too fast")
    return run_workflow(library, parser, lambda args: _play(library, args), arguments)


def _play(library: Library, args: argparse.Namespace) -> None:
    name = Path(args.task).stem
    logs = Path(args.logs)
    if args.checkpoint is None:
        checkpoint = last_checkpoint(logs, library, name)
    else:
        checkpoint = Path(args.checkpoint).expanduser()
    read_parameters(checkpoint, library)  # whose it is, before its folder's agent file is read
    file = args.agent or agent_file_of(checkpoint)
    content = load_agent_file(library.name, name, file and str(file), agent_words(args))
    made = make_task(args, seed_of(content), plays=True)
    try:
        agent = library.make_agent(made.task, content, made.rl_device, made.seed)
        made.fit_threads(made.task.num_envs, agent.num_parameters)
        agent.load(checkpoint)
        log.info("checkpoint: %s", checkpoint)
        made.watch(folder_of(checkpoint), f"play_{date()}")
        step = agent.player()
        if args.real_time:
            step = _in_real_time(step, made.task.simulation.dt)
        played = play_episodes(agent.stepper, step)
        sys.stdout.write("\n".join([*played.lines(), ""]))
        sys.stdout.flush()
        with contextlib.suppress(KeyboardInterrupt):
            while made.task.is_watched:
                step()
    finally:
        made.close()


def _in_real_time(step: Callable[[], None], dt_s: float) -> Callable[[], None]:
    """Return steps that begin no sooner after each other than the simulated time passes."""
    next_step_s = time.monotonic()

    def paced() -> None:
        nonlocal next_step_s
        time.sleep(max(0.0, next_step_s - time.monotonic()))
        next_step_s = max(next_step_s, time.monotonic()) + dt_s
        step()

    return paced


def play_episodes(stepper: AutoresetTask, step: Callable[[], None]) -> Played:
    """Step until every environment ended an episode; the first of each counts.

    Were all episodes counted that end in some time, short ones would be too many.
    """
    returns = torch.zeros(stepper.num_envs, dtype=torch.float64)
    lengths = torch.zeros(stepper.num_envs, dtype=torch.int64)
    truncated = torch.zeros(stepper.num_envs, dtype=torch.bool)
    while not lengths.all():
        step()
        assert stepper.last_step is not None
        episodes = stepper.last_step.episodes
        ids = episodes.env_ids.cpu()
        first = lengths[ids] == 0
        returns[ids[first]] = episodes.returns.cpu()[first]
        lengths[ids[first]] = episodes.lengths.cpu()[first]
        truncated[ids[first]] = stepper.last_step.truncated.cpu()[ids[first]]
    return Played(returns, lengths, truncated)
