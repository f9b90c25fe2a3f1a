"""Trains or plays an agent: python train.py task=HumanoidAMP [key=value ...].

A user's mistake costs about a second and ends in one line and exit code 2: the configuration is
composed and checked before torch, MuJoCo and rl_games are imported.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import sys
from collections.abc import Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from isaacgymenvs_lite.checkpoints.policy_arguments import complete_arguments
from isaacgymenvs_lite.config.compose import checked_program, make_loader
from isaacgymenvs_lite.config.hydra_bridge import (
    CONFIG_NAME,
    HYDRA_VERSION_BASE,
    NamedFiles,
    options_parser,
)
from isaacgymenvs_lite.config.hydra_errors import ComposeError, explain
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.config.path_overrides import PathOverrides
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.errors import ConfigError, StoppedAtOnceError, UserError
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.pbt.restart import RestartRequest, start_again
from isaacgymenvs_lite.typed_command import TypedCommand, words_of_job

log = logging.getLogger(__name__)

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130


def main() -> None:
    """Run the command line in `sys.argv`; exits with 2 after a user's mistake.

    A second Ctrl-C or SIGTERM ends with 130 or 143, as shells expect.
    """
    configure_logging()
    try:
        _run_hydra()
    except UserError as error:
        _fail(error)
    except KeyboardInterrupt as interrupt:
        status = EXIT_INTERRUPTED
        if isinstance(interrupt, StoppedAtOnceError):
            status = interrupt.exit_status
        log.warning("ended by the user: exit status %d", status)
        sys.exit(status)


def configure_logging() -> None:
    """Send the log to stderr, messages only, without breaking a progress bar."""
    logging.basicConfig(level=logging.INFO, handlers=[message_handler()], force=True)


def message_handler() -> logging.Handler:
    """Return what writes a log as this command line does."""
    handler = _ProgressBarHandler()
    handler.setFormatter(_MessageFormatter())
    return handler


def _run_hydra() -> None:
    """Let Hydra compose the configuration and run the job.

    Raises:
        ConfigError: the configuration cannot be composed.
    """
    command = TypedCommand.of_this_process()
    if any(word.startswith("resume=") and word != "resume=" for word in sys.argv[1:]):
        from isaacgymenvs_lite.checkpoints.run_config import resumed_tree  # imports torch

        _run_job(resumed_tree(sys.argv[1:]), command)
        return
    _check_options(sys.argv[1:])
    sys.argv[1:] = complete_arguments(sys.argv[1:])  # of a shipped policy that is played
    register_resolvers()
    # Hydra prints its errors itself, over several lines, and exits; in this mode it raises them.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    started = False

    def job(cfg: DictConfig) -> None:
        nonlocal started
        started = True
        _refuse_policies_in_turns(cfg)
        _run_job(cfg, _command_of_job(command))

    decorate = hydra.main(
        config_path=str(cfg_dir()), config_name=CONFIG_NAME, version_base=HYDRA_VERSION_BASE
    )
    named = PathOverrides.from_words(sys.argv[1:])
    sys.argv[1:] = named.words
    try:
        with checked_program(named.files):
            decorate(job)()
    except ComposeError as error:
        if started:
            raise
        raise _explain(error, named.files) from error


def _command_of_job(command: TypedCommand) -> TypedCommand:
    """Return the command line of one job, of a sweep or not."""
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        return command
    words = words_of_job(command.words, HydraConfig.get().overrides.task)
    return dataclasses.replace(command, words=tuple(words))


def _refuse_policies_in_turns(cfg: DictConfig) -> None:
    """Refuse a sweep over the policies of a population, which train at the same time."""
    is_sweep = HydraConfig.get().mode == RunMode.MULTIRUN
    if is_sweep and OmegaConf.select(cfg, "pbt.enabled"):
        _fail(
            ConfigError(
                "--multirun trains one run after the other, and the policies of a population train"
                " at the same time; start each in a process of its own: pbt.policy_idx=0, 1, ..."
            )
        )


def _run_job(cfg: DictConfig, command: TypedCommand) -> None:
    """Check the composed tree, then train or play.

    A user's mistake exits here, because Hydra would print another line before raising it.
    """
    try:
        check_config(cfg)
        from isaacgymenvs_lite.runner import run  # torch, MuJoCo and rl_games: after the checks

        run(cfg, command)
    except UserError as error:
        _fail(error)
    except RestartRequest as request:
        start_again(request, command.words)


def _explain(error: Exception, files: NamedFiles) -> ConfigError:
    """Return the one-line error for what Hydra raised on this command line."""
    args = options_parser().parse_args()
    loader = make_loader(args.config_dir, args.config_path, files)
    return explain(error, args.overrides, loader, args.config_name or CONFIG_NAME)


def _check_options(arguments: Sequence[str]) -> None:
    """Refuse options with dashes that are not Hydra's, such as those of ASE's launcher.

    Raises:
        ConfigError: there is one.
    """
    parser = options_parser()
    parser.allow_abbrev = False
    options, others = parser.parse_known_args(list(arguments))
    if options.experimental_rerun is not None:
        raise ConfigError(
            "--experimental-rerun reads a pickle, which can run code; give the words of the command"
            " line once more (config.yaml in the run folder has them)"
        )
    if others:
        name = others[0].lstrip("-").split("=")[0]
        raise ConfigError(
            f"unknown option '{others[0]}': settings are written without dashes, {name}=<value>; "
            "--help lists them"
        )


def _fail(error: UserError) -> None:
    print(f"error: {error}", file=sys.stderr)
    sys.exit(EXIT_USER_ERROR)


class _ProgressBarHandler(logging.Handler):
    """Writes above a running progress bar instead of through it."""

    def emit(self, record: logging.LogRecord) -> None:
        # A terminal that was closed takes nothing more; the training goes on to its checkpoint.
        with contextlib.suppress(OSError):
            tqdm.write(self.format(record), file=sys.stderr)


class _MessageFormatter(logging.Formatter):
    """The message; from warnings upwards with the level before it."""

    def format(self, record: logging.LogRecord) -> str:
        message = super().format(record)
        if record.levelno < logging.WARNING:
            return message
        return f"{record.levelname.lower()}: {message}"


if __name__ == "__main__":
    main()
