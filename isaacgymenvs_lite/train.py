"""Trains or plays an agent: python train.py task=HumanoidAMP [key=value ...].

With -m it runs several jobs, see `run.sweep`. A job returns the result of `runner.run`.

The configuration is composed and checked before torch, MuJoCo and rl_games are imported. A user's
mistake is therefore reported after about a second, by one line and exit code 2.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import logging
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from tqdm import tqdm

from isaacgymenvs_lite.checkpoints.policy_arguments import complete_arguments, inherited_settings
from isaacgymenvs_lite.command_line import EscapingFormatter
from isaacgymenvs_lite.config.compose import HYDRA_VERSION_BASE, ComposeError, explain
from isaacgymenvs_lite.config.launch import read_config
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.run_names import train_dir_of
from isaacgymenvs_lite.config.staging import ROOT, staged
from isaacgymenvs_lite.distributed import started_by_torchrun, words_after_restart
from isaacgymenvs_lite.errors import (
    EXIT_INTERRUPTED,
    EXIT_USER_ERROR,
    ConfigError,
    JobError,
    PeerError,
    PeerMistakeError,
    StoppedAtOnceError,
    UserError,
    one_line,
)
from isaacgymenvs_lite.paths import check_working_folder
from isaacgymenvs_lite.pbt.restart import RestartRequest, start_again
from isaacgymenvs_lite.run.sweep import Summary, check_words, run_job, waiting_for_jobs
from isaacgymenvs_lite.typed_command import TypedCommand, words_of_job

log = logging.getLogger(__name__)

EXIT_FAILED_JOBS = 1
_NO_COMPILER = "TORCHDYNAMO_DISABLE"

# How long (s) a process waits until another process of the training has reported its mistake.
_REPORT_S = 10.0
# Maps each option of Hydra to whether the option has a value.
_OPTIONS = {
    **dict.fromkeys(("--help", "-h", "--hydra-help", "--version", "--resolve"), False),
    **dict.fromkeys(("--run", "-r", "--multirun", "-m"), False),
    **dict.fromkeys(("--cfg", "-c", "--package", "-p", "--info", "-i"), True),
    **dict.fromkeys(("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd"), True),
    **dict.fromkeys(("--shell-completion", "-sc"), False),
}


def main() -> None:
    """Run the command line in `sys.argv`.

    The exit code is 2 after a user's mistake, 1 if a job of a sweep has failed, and 130 or 143
    after a second Ctrl-C or SIGTERM, as shells expect.
    """
    configure_logging()
    try:
        check_working_folder()
        command = TypedCommand.of_this_process()
        if started_by_torchrun():
            from isaacgymenvs_lite.run.folder import run_folders

            runs = run_folders(train_dir_of(sys.argv[1:]))
            sys.argv[1:] = words_after_restart(sys.argv[1:], runs) or sys.argv[1:]
        if any(word.startswith("resume=") and word != "resume=" for word in sys.argv[1:]):
            from isaacgymenvs_lite.checkpoints.run_config import resumed_tree  # imports torch

            _run_job(resumed_tree(sys.argv[1:]), command)
        else:
            _run_hydra(sys.argv[1:], command)
    except UserError as error:
        _fail(error)
    except KeyboardInterrupt as interrupt:
        status = EXIT_INTERRUPTED
        if isinstance(interrupt, StoppedAtOnceError):
            status = interrupt.exit_status
        log.warning("ended by the user: exit status %d", status)
        sys.exit(status)


def _run_hydra(words: Sequence[str], command: TypedCommand) -> None:
    """Let Hydra compose the configuration and run the job, or the jobs of a sweep."""
    check_words(words)
    Summary.num_failed = 0
    command = dataclasses.replace(command, words=(*inherited_settings(words), *command.words))
    options, overrides = split_options(complete_arguments(words))
    folders = [
        next((options.pop(name) for name in names if name in options), None)
        for names in (("--config-dir", "-cd"), ("--config-path", "-cp"))
    ]
    register_resolvers()
    # Hydra normally prints an error over several lines and exits; in this mode it raises the error.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    launcher = next((word for word in overrides if word.startswith("hydra/launcher=")), None)
    waiting = waiting_for_jobs() if launcher else contextlib.nullcontext()
    started, parent = False, os.getpid()

    def job(cfg: DictConfig) -> float | None:
        nonlocal started
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return _run_job_of_sweep(cfg, command, parent)
        started = True
        return _run_job(cfg, command)

    with staged(overrides, *folders) as files, waiting:
        typed = [part for option in options.items() for part in option if part is not None]
        sys.argv[1:] = [*typed, *files.words]
        program: Callable[..., None] = hydra.main(
            config_path=str(files.folder), config_name=ROOT, version_base=HYDRA_VERSION_BASE
        )(job)
        try:
            program()
        except UserError:
            raise
        except Exception as error:
            if isinstance(error, ComposeError) and not started:
                raise explain(error, files) from error
            if launcher is None or isinstance(error, ComposeError):
                raise
            raise JobError(
                f"{launcher} has failed: {type(error).__name__}: {one_line(error)}; only the run"
                " folders of this batch of jobs are left"
            ) from error
    if Summary.num_failed:
        sys.exit(EXIT_FAILED_JOBS)


def split_options(words: Sequence[str]) -> tuple[dict[str, str | None], list[str]]:
    """Return Hydra's options with their values, and the overrides."""
    options, overrides = dict[str, str | None](), list[str]()
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if not word.startswith("-"):
            overrides.append(word)
        elif name == "--experimental-rerun":
            raise ConfigError(
                "--experimental-rerun reads a pickle, which can run code; type the settings of the"
                " command line once more (config.yaml in the run folder has them)"
            )
        elif name not in _OPTIONS:
            raise ConfigError(
                f"unknown option '{word}': settings are written without dashes,"
                f" {name.lstrip('-')}=<value>; --help lists them"
            )
        elif equals or not _OPTIONS[name]:
            options[name] = value if equals else None
        else:
            options[name] = next(rest, None)
    return options, overrides


def _run_job(cfg: DictConfig, command: TypedCommand) -> float | None:
    """Check the composed tree, then train or play a policy; return the result of the run.

    A user's mistake ends the process here, because Hydra prints a line before it passes on an
    error.
    """
    try:
        return _run(cfg, command)
    except UserError as error:
        _fail(error)
    except RestartRequest as request:
        start_again(request, command.words)


def _run_job_of_sweep(cfg: DictConfig, command: TypedCommand, parent: int) -> float | None:
    """Run one job of a sweep, in the sweep's process (id `parent`) or in another process."""
    hydra_job = HydraConfig.get()
    words = words_of_job(command.words, hydra_job.overrides.task)
    job = dataclasses.replace(command, words=tuple(words), is_job=True)
    if os.getpid() != parent:
        configure_logging(prefix=f"#{hydra_job.job.num} ")
    return run_job(functools.partial(_run, cfg, job), parent)


def _run(cfg: DictConfig, command: TypedCommand, **of_sweep: Any) -> float | None:
    config = read_config(cfg)
    if _NO_COMPILER not in os.environ:
        # rl_games compiles a test network when it is imported, which takes two seconds.
        os.environ[_NO_COMPILER] = "1"
        importlib.import_module("isaacgymenvs_lite.registration")
        del os.environ[_NO_COMPILER]
    from isaacgymenvs_lite.runner import run  # imports torch, MuJoCo and rl_games

    return run(config, command, **of_sweep)


def _fail(error: UserError) -> NoReturn:
    if started_by_torchrun() and not isinstance(error, PeerError):
        from isaacgymenvs_lite.distributed.group import first_of_all  # imports torch

        error = first_of_all(error)
    if isinstance(error, PeerMistakeError):
        log.info("%s", error)
        # torchrun ends all processes as soon as this process ends, so wait for the process that
        # reports the mistake.
        time.sleep(_REPORT_S)
    else:
        print(f"error: {error}", file=sys.stderr)
    sys.exit(EXIT_USER_ERROR)


# --- the log --------------------------------------------------------------------------------------


def configure_logging(prefix: str = "") -> None:
    """Send the log to stderr, messages only, without breaking a progress bar."""
    # Rank 0 logs all messages; processes of other ranks log only errors.
    level = logging.INFO if os.environ.get("RANK", "0") == "0" else logging.ERROR
    logging.basicConfig(level=level, handlers=[message_handler(prefix)], force=True)


def message_handler(prefix: str = "") -> logging.Handler:
    """Return the log handler of this command line; each message begins with `prefix`."""
    handler = _ProgressBarHandler()
    handler.setFormatter(_MessageFormatter(f"{prefix}%(message)s"))
    return handler


class _ProgressBarHandler(logging.Handler):
    """Writes messages above a running progress bar, which stays intact."""

    def emit(self, record: logging.LogRecord) -> None:
        # If the terminal was closed, the training still continues until its checkpoint.
        with contextlib.suppress(OSError):
            tqdm.write(self.format(record), file=sys.stderr)


class _MessageFormatter(EscapingFormatter):
    """Formats a record as its message, with the level in front of warnings and errors."""

    def format(self, record: logging.LogRecord) -> str:
        message = super().format(record)
        if record.levelno < logging.WARNING:
            return message
        return f"{record.levelname.lower()}: {message}"


if __name__ == "__main__":
    main()
