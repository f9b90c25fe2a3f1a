"""Trains or plays an agent: python train.py task=HumanoidAMP [key=value ...].

With -m it runs several jobs, see `sweep`. A job returns the number that `runner.run` returns.

A user's mistake costs about a second and ends in one line and exit code 2: the configuration is
composed and checked before torch, MuJoCo and rl_games are imported.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import os
import sys
import time
from collections.abc import Sequence
from typing import Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from isaacgymenvs_lite.checkpoints.policy_arguments import complete_arguments, inherited_settings
from isaacgymenvs_lite.command_line import EscapingFormatter
from isaacgymenvs_lite.config.compose import checked_program, make_loader
from isaacgymenvs_lite.config.hydra_bridge import (
    CONFIG_NAME,
    HYDRA_VERSION_BASE,
    NamedFiles,
    options_parser,
    sweeps_report_to,
)
from isaacgymenvs_lite.config.hydra_errors import ComposeError, explain
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.config.path_overrides import PathOverrides
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.run_names import train_dir_of
from isaacgymenvs_lite.distributed import started_by_torchrun
from isaacgymenvs_lite.distributed.restarts import words_after_restart
from isaacgymenvs_lite.errors import (
    EXIT_INTERRUPTED,
    EXIT_USER_ERROR,
    ConfigError,
    PeerError,
    PeerMistakeError,
    StoppedAtOnceError,
    UserError,
)
from isaacgymenvs_lite.paths import cfg_dir, check_working_folder
from isaacgymenvs_lite.pbt.restart import RestartRequest, start_again
from isaacgymenvs_lite.sweep import (
    Sweep,
    is_sweep,
    numbered_output,
    run_job,
    this_process,
    waiting_for_jobs,
    with_failures_allowed,
)
from isaacgymenvs_lite.typed_command import TypedCommand, words_of_job
from isaacgymenvs_lite.utils.late_compile import compiling_late

log = logging.getLogger(__name__)

EXIT_FAILED_JOBS = 1

# How long another process of a data-parallel training has to report its mistake.
_REPORT_S = 10.0


def main() -> None:
    """Run the command line in `sys.argv`; exits with 2 after a user's mistake.

    A sweep exits with 1 if a job has failed.

    A second Ctrl-C or SIGTERM ends with 130 or 143, as shells expect.
    """
    configure_logging()
    try:
        check_working_folder()
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
    # Of several processes one logs; the others report what only they can.
    level = logging.INFO if os.environ.get("RANK", "0") == "0" else logging.ERROR
    logging.basicConfig(level=level, handlers=[message_handler()], force=True)


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
    _go_on_after_restart()
    if any(word.startswith("resume=") and word != "resume=" for word in sys.argv[1:]):
        from isaacgymenvs_lite.checkpoints.run_config import resumed_tree  # imports torch

        _run_job(resumed_tree(sys.argv[1:]), command)
        return
    sys.argv[1:] = _options_first(sys.argv[1:])
    command = command.after(inherited_settings(sys.argv[1:]))
    sys.argv[1:] = complete_arguments(sys.argv[1:])
    register_resolvers()
    # Hydra prints its errors itself, over several lines, and exits; in this mode it raises them.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    started, parent, sweep = False, this_process(), Sweep()

    def job(cfg: DictConfig) -> float | None:
        nonlocal started
        if is_sweep():
            return _run_job_of_sweep(cfg, command, parent)
        started = True
        return _run_job(cfg, command)

    decorate = hydra.main(
        config_path=str(cfg_dir()), config_name=CONFIG_NAME, version_base=HYDRA_VERSION_BASE
    )
    named = PathOverrides.from_words(with_failures_allowed(sys.argv[1:]))
    sys.argv[1:] = named.words
    try:
        with checked_program(named.files), sweeps_report_to(sweep.add, waiting_for_jobs):
            decorate(job)()
    except ComposeError as error:
        if started:
            raise
        if not sweep.all_failed:  # of which Optuna would only say that there is no best trial
            raise _explain(error, named.files) from error
    finally:
        sweep.report()
    if sweep.num_failed:
        sys.exit(EXIT_FAILED_JOBS)


def _go_on_after_restart() -> None:
    """Replace the command line by one that goes on, if torchrun has restarted this process."""
    if not started_by_torchrun():
        return
    from isaacgymenvs_lite.run.folder import run_folders

    runs = run_folders(train_dir_of(sys.argv[1:]))
    if (words := words_after_restart(sys.argv[1:], runs)) is not None:
        sys.argv[1:] = words


def _run_job(cfg: DictConfig, command: TypedCommand) -> float | None:
    """Check the composed tree, then train or play; return the number of the run.

    A user's mistake exits here, because Hydra would print another line before raising it.
    """
    try:
        return _run(cfg, command)
    except UserError as error:
        _fail(error)
    except RestartRequest as request:
        start_again(request, command.words)


def _run_job_of_sweep(cfg: DictConfig, command: TypedCommand, parent: str) -> float | None:
    """Do the same as one of several jobs, in the sweep's own process, `parent`, or another one.

    Raises:
        JobError: the job has failed.
    """
    words = words_of_job(command.words, HydraConfig.get().overrides.task)
    job = dataclasses.replace(command, words=tuple(words), is_job=True)
    in_parent = parent == this_process()
    with contextlib.nullcontext() if in_parent else numbered_output():
        if not in_parent:
            configure_logging()
        return run_job(functools.partial(_run, cfg, job), cfg, command.words, parent)


def _run(cfg: DictConfig, command: TypedCommand, **of_sweep: Any) -> float | None:
    check_config(cfg)
    with compiling_late():
        from isaacgymenvs_lite.runner import run  # torch, MuJoCo and rl_games: after the checks

    return run(cfg, command, **of_sweep)


def _explain(error: Exception, files: NamedFiles) -> ConfigError:
    """Return the one-line error for what Hydra raised on this command line."""
    args = options_parser().parse_args()
    loader = make_loader(args.config_dir, args.config_path, files)
    return explain(error, args.overrides, loader, args.config_name or CONFIG_NAME)


def _options_first(arguments: Sequence[str]) -> list[str]:
    """Return the command line with Hydra's options before the settings, as Hydra reads them.

    Raises:
        ConfigError: Hydra does not know an option with dashes, as `--task` of ASE's launcher.
    """
    parser = options_parser()
    parser.allow_abbrev = False
    options, others = parser.parse_known_intermixed_args(list(arguments))
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
    first = list(arguments)
    for word in options.overrides:
        first.remove(word)
    return [*first, *options.overrides]


def _fail(error: UserError) -> NoReturn:
    if started_by_torchrun() and not isinstance(error, PeerError):
        from isaacgymenvs_lite.distributed.group import first_of_all  # imports torch

        error = first_of_all(error)
    if isinstance(error, PeerMistakeError):
        log.info("%s", error)
        time.sleep(_REPORT_S)  # once this process ends, torchrun ends the one that reports it
    else:
        print(f"error: {error}", file=sys.stderr)
    sys.exit(EXIT_USER_ERROR)


class _ProgressBarHandler(logging.Handler):
    """Writes above a running progress bar instead of through it."""

    def emit(self, record: logging.LogRecord) -> None:
        # A terminal that was closed takes nothing more; the training goes on to its checkpoint.
        with contextlib.suppress(OSError):
            tqdm.write(self.format(record), file=sys.stderr)


class _MessageFormatter(EscapingFormatter):
    """The message; from warnings upwards with the level before it."""

    def format(self, record: logging.LogRecord) -> str:
        message = super().format(record)
        if record.levelno < logging.WARNING:
            return message
        return f"{record.levelname.lower()}: {message}"


if __name__ == "__main__":
    main()
