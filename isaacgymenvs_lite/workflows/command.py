"""The command line of the workflows: `key=value` as for train.py, Isaac Lab's options as synonyms.

    isaacgymenvs-lite workflows sb3 train task=Ant num_envs=64 agent.ppo.gamma=0.98
    python -m isaacgymenvs_lite.workflows.sb3.train --task Ant --num_envs 64 agent.ppo.gamma=0.98

Each option is a synonym of a key. A key belongs to the command (`TrainSettings`, `PlaySettings`),
to the agent file (`agent.`) or to the task, where it means the same as for train.py.
"""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NoReturn, TypeVar

from omegaconf import OmegaConf
from yaml import YAMLError

from isaacgymenvs_lite.command_line import log_messages
from isaacgymenvs_lite.config.devices import check_device
from isaacgymenvs_lite.errors import (
    EXIT_INTERRUPTED,
    EXIT_USER_ERROR,
    ConfigError,
    UserError,
    suggest,
)
from isaacgymenvs_lite.gymnasium_ids import task_of_id
from isaacgymenvs_lite.schema import keys_of, read_section, setting
from isaacgymenvs_lite.utils.optional_packages import require
from isaacgymenvs_lite.workflows.agent_files import PREFIX
from isaacgymenvs_lite.workflows.library import Library

log = logging.getLogger(__name__)

LAST = "last"
"""`checkpoint=last`: the newest checkpoint of the task's trainings."""

# Keys of cfg/config.yaml that apply to another library's agent too.
_TASK_KEYS = {
    *("task", "seed", "num_envs", "torch_deterministic"),
    *("sim_device", "rl_device", "pipeline", "num_threads"),
    *("headless", "force_render", "viewer", "viewer_port", "viewer_host", "viewer_allowed_hosts"),
    *("capture_video", "capture_video_freq", "capture_video_len", "capture_video_envs"),
    *("physics_engine", "solver_type", "num_subscenes", "graphics_device_id"),
}
# Keys that do not, and what to use.
_COUNTERPARTS = {
    "train": f"agent=FILE and {PREFIX}key=value",
    "experiment": "logs=FOLDER",
    "full_experiment_name": "logs=FOLDER",
    "test": "the command play",
}
# Options of Isaac Lab whose key has the same name.
_SYNONYMS = (
    *("task", "num_envs", "seed", "agent", "logs", "checkpoint"),
    *("max_iterations", "log_interval", "real_time"),
)
# Isaac Lab's options that have no effect here, without a value and with one: pictures need no
# switch, infos are complete, and there is no Kit.
_IDLE_FLAGS = (
    *("enable_cameras", "keep_all_info", "disable_fabric", "export_io_descriptors"),
    *("verbose", "info"),
)
_IDLE_VALUES = ("kit_args", "experience", "rendering_mode")
# Isaac Lab's options that are refused, and what to use.
_REFUSED = {
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
_HELP = f"""{{verb}}s an agent of {{title}}.

keys:
  task=NAME               a task file, its path, or IsaacGymEnvsLite/Ant-v0
  agent=NAME              an agent file or its path; default: the task's
  checkpoint=FILE         {{checkpoint}}
  logs=FOLDER             folder of all trainings; default: logs
{{keys}}
  num_envs=N, seed=N, rl_device=cuda:0, headless=False, viewer=web, capture_video=True,
  task.env.episodeLength=200, ...: as for train.py
  {PREFIX}KEY=VALUE         any key of the agent file
"""
_VERB_HELP = {
    "train": {
        "checkpoint": "to start from; last: the task's newest",
        "keys": """\
  max_iterations=N        rollouts, each with its updates; default: the agent file's
  log_interval=N          frames from one log entry to the next""",
    },
    "play": {
        "checkpoint": "default: last, the task's newest",
        "keys": """\
  real_time=True          wait where steps are faster than the simulated time""",
    },
}
# Isaac Lab's defaults of --video, in control steps. A play is recorded once.
_VIDEO_LENGTH, _VIDEO_INTERVAL, _ONCE = 200, 2000, 2**53


@dataclass(frozen=True, kw_only=True)
class CommandSettings:
    """The keys that training and playing have in common."""

    task: str = setting()
    """Name or path of a task file, or a task's name in Gymnasium."""
    agent: str = setting("")
    """Agent file or its name; '': the task's."""
    checkpoint: str = setting("")
    """File, or `last`."""
    logs: str = setting("logs")
    """Folder of all trainings."""


@dataclass(frozen=True, kw_only=True)
class TrainSettings(CommandSettings):
    """The keys of `train`; a checkpoint is the start of the training."""

    max_iterations: int | None = setting(None, minimum=1)
    """Rollouts; None: the agent file's."""
    log_interval: int | None = setting(None, minimum=1)
    """Frames from one log entry to the next; None: the library's own."""


@dataclass(frozen=True, kw_only=True)
class PlaySettings(CommandSettings):
    """The keys of `play`; without a checkpoint the last one is played."""

    real_time: bool = setting(False)
    """Wait where steps are faster than the simulated time."""


Settings = TypeVar("Settings", TrainSettings, PlaySettings)


@dataclass(frozen=True)
class Command(Generic[Settings]):
    """A command line, sorted.

    Attributes:
        settings: the command's own keys.
        task_words: `key=value` each, for composing the task.
        agent_words: `agent.key=value` each, for the agent file.
    """

    settings: Settings
    task_words: tuple[str, ...]
    agent_words: tuple[str, ...]


def run_workflow(
    library: Library,
    verb: str,
    settings: type[Settings],
    action: Callable[[Command[Settings]], None],
    arguments: Sequence[str] | None,
) -> int:
    """Read the command line and run it; a user's mistake is one line and exit code 2.

    Args:
        library: must be installed.
        verb: `train` or `play`.
        settings: the keys of the verb.
        action: what the command does.
        arguments: without the program's name; None = `sys.argv`.

    Returns:
        The exit code.
    """
    # rsl_rl imports GitPython, whose import fails where there is no git.
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    parser = make_parser(library, verb)
    args = parser.parse_intermixed_args(arguments)
    log_messages()
    try:
        require(library.package, parser.prog)
        _log_idle_options(args)
        action(read_command(settings, args))
    except UserError as error:
        parser.exit(EXIT_USER_ERROR, f"error: {error}\n")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return 0


def read_command(settings: type[Settings], args: argparse.Namespace) -> Command[Settings]:
    """Sort the keys of a parsed command line by what they belong to.

    Args:
        settings: the keys of the verb.
        args: from `make_parser`.

    Raises:
        UserError: a key that has no effect here, or a value that cannot be used.
    """
    known = keys_of(settings)
    options = _keys_of_options(args)
    task_words = [f"{key}={value}" for key, value in options.items() if key not in known]
    own_words, agent_words = list[str](), list[str]()
    for word in args.words:
        key, equals, _ = word.partition("=")
        if equals and key in known:
            if key in options:
                raise ConfigError(f"{word}: given as an option as well; leave one of them out")
            own_words.append(word)
        elif key.startswith(PREFIX):
            agent_words.append(word)
        else:
            _check_task_word(word, known)
            task_words.append(word)
    try:
        typed = OmegaConf.to_container(OmegaConf.from_dotlist(own_words))
    except YAMLError as error:
        raise ConfigError(f"{' '.join(own_words)}: a value is not valid YAML") from error
    values = {key: value for key, value in options.items() if key in known}
    assert isinstance(typed, dict)
    values |= {str(key): value for key, value in typed.items()}
    if not values.get("task"):
        raise ConfigError("task= is missing, for example task=Cartpole; --help lists the keys")
    values["task"] = task_of_id(str(values["task"]))
    own = read_section(settings, values, where="", complete=True)
    return Command(own, tuple(task_words), tuple(agent_words))


def _keys_of_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return what the given options mean as keys.

    Raises:
        DeviceError: a device that this machine does not have.
    """
    keys = {key: getattr(args, key, None) for key in _SYNONYMS}
    if args.device is not None:
        check_device(args.device, "--device")
        keys["rl_device"] = args.device
    if (args.livestream or 0) > 0:
        keys["viewer"] = "web"
    if args.video:
        keys["capture_video"] = True
        keys["capture_video_len"] = args.video_length
        keys["capture_video_freq"] = getattr(args, "video_interval", _ONCE)
    return {key: value for key, value in keys.items() if value is not None}


def _check_task_word(word: str, known: frozenset[str]) -> None:
    """Check that a word is about the task, its devices or its viewers.

    Raises:
        ConfigError: only train.py's own agents read it, or nothing does.
    """
    path = word.lstrip("+~").partition("=")[0]
    root = path.partition(".")[0]
    if root in _TASK_KEYS and path != "task":
        return
    if root in _COUNTERPARTS:
        hint = f"use {_COUNTERPARTS[root]}"
    else:
        keys = ", ".join(sorted(known))
        hint = f"expected {keys}, {PREFIX}key=value, or a key of the task such as task.env.numEnvs"
    near = suggest(root, {*known, *_TASK_KEYS})
    raise ConfigError(f"{word}: is no setting of another library's agent{near}; {hint}")


def _log_idle_options(args: argparse.Namespace) -> None:
    given = [f"--{name}" for name in (*_IDLE_FLAGS, *_IDLE_VALUES) if getattr(args, name)]
    if given:
        log.info("%s: nothing to do for it here", ", ".join(given))


class _Parser(argparse.ArgumentParser):
    """Reports a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        words = message.split()
        if message.startswith("unrecognized arguments:"):
            known = [name for action in self._actions for name in action.option_strings]
            message += suggest(words[2].partition("=")[0], known)
        self.exit(EXIT_USER_ERROR, f"error: {message}; --help lists the options\n")


class _Refused(argparse.Action):
    """Ends the command with what to use in place of an option."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        hint = _REFUSED[self.dest]
        parser.exit(EXIT_USER_ERROR, f"error: {option_string}: {hint}\n")


def make_parser(library: Library, verb: str) -> argparse.ArgumentParser:
    """Return a parser for the words of a command line and for Isaac Lab's options.

    Args:
        library: whose agents.
        verb: `train` or `play`.
    """
    title = library.title
    parser = _Parser(
        prog=f"isaacgymenvs-lite workflows {library.name} {verb}",
        usage="%(prog)s task=<name> [key=value ...]",
        description=_HELP.format(verb=verb.capitalize(), title=title, **_VERB_HELP[verb]),
        epilog="Other options of Isaac Lab's scripts are accepted, or refused with what to use.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("words", nargs="*", metavar="key=value", help="see above")
    parser.add_argument("--task", help="task=")
    parser.add_argument("--num_envs", type=_positive, help="num_envs=")
    parser.add_argument("--seed", type=int, help="seed=; -1 draws one")
    parser.add_argument("--headless", action="store_true", help="headless=True, the default")
    parser.add_argument("--livestream", type=int, choices=(-1, 0, 1, 2), help="1, 2: viewer=web")
    parser.add_argument("--device", help="rl_device=")
    parser.add_argument(
        "--cpu", action="store_const", const="cpu", dest="device", help="rl_device=cpu"
    )
    parser.add_argument("--agent", help="agent=")
    parser.add_argument("--logs", help="logs=")
    parser.add_argument("--video", action="store_true", help="capture_video=True")
    length = f"capture_video_len=; default: {_VIDEO_LENGTH}"
    parser.add_argument("--video_length", type=_positive, default=_VIDEO_LENGTH, help=length)
    if verb == "train":
        _add_train_options(parser)
    else:
        _add_play_options(parser)
    _add_hidden_options(parser)
    return parser


def _add_train_options(parser: argparse.ArgumentParser) -> None:
    interval = f"capture_video_freq=; default: {_VIDEO_INTERVAL}"
    parser.add_argument("--video_interval", type=_positive, default=_VIDEO_INTERVAL, help=interval)
    parser.add_argument("--max_iterations", type=_positive, help="max_iterations=")
    parser.add_argument("--log_interval", type=_positive, help="log_interval=")
    parser.add_argument("--checkpoint", help="checkpoint=")


def _add_play_options(parser: argparse.ArgumentParser) -> None:
    checkpoint = parser.add_mutually_exclusive_group()
    checkpoint.add_argument("--checkpoint", help="checkpoint=")
    checkpoint.add_argument(
        "--use_last_checkpoint",
        action="store_const",
        const=LAST,
        dest="checkpoint",
        help="checkpoint=last, the default",
    )
    parser.add_argument(
        "--real-time", action="store_const", const=True, dest="real_time", help="real_time=True"
    )


def _add_hidden_options(parser: argparse.ArgumentParser) -> None:
    hidden = argparse.SUPPRESS
    for name in _IDLE_FLAGS:
        parser.add_argument(f"--{name}", action="store_true", help=hidden)
    for name in _IDLE_VALUES:
        parser.add_argument(f"--{name}", help=hidden)
    for name in _REFUSED:
        parser.add_argument(f"--{name}", action=_Refused, nargs="?", help=hidden)
    # skrl's scripts have these two; there is one choice of each.
    parser.add_argument("--ml_framework", choices=("torch",), help=hidden)
    parser.add_argument("--algorithm", type=str.upper, choices=("PPO",), help=hidden)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}: expected a whole number >= 1")
    return value
