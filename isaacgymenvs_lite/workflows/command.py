"""The command line of the workflows: `key=value` as for train.py, Isaac Lab's options as synonyms.

    isaacgymenvs-lite workflows sb3 train task=Ant num_envs=64 agent.ppo.gamma=0.98
    python -m isaacgymenvs_lite.workflows.sb3.train --task Ant --num_envs 64 agent.ppo.gamma=0.98

An option stands for a word. A key belongs to the command (`TrainSettings`, `PlaySettings`), to the
agent file (`agent.`) or to the task, where it means the same as for train.py.
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import dataclass
from typing import Any, Generic, NoReturn, TypeVar

from omegaconf import OmegaConf
from yaml import YAMLError

from isaacgymenvs_lite.errors import EXIT_USER_ERROR, ConfigError, suggest
from isaacgymenvs_lite.gymnasium_ids import task_of_id
from isaacgymenvs_lite.schema import keys_of, read_section, setting
from isaacgymenvs_lite.workflows.agent_files import PREFIX
from isaacgymenvs_lite.workflows.library import Library

log = logging.getLogger(__name__)

LAST = "last"
"""`checkpoint=last`: the newest checkpoint of the task's trainings."""

# Keys of cfg/config.yaml that apply to another library's agent too.
_TASK_KEYS = {
    *("task", "seed", "num_envs", "torch_deterministic"),
    *("sim_device", "rl_device", "pipeline", "num_threads"),
    *("headless", "force_render", "viewer", "viewer_port"),
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
# Isaac Lab's options -> the words that they stand for; {} is the option's value. A play is recorded
# once.
_OPTIONS = {
    "task": "task={}",
    "num_envs": "num_envs={}",
    "seed": "seed={}",
    "headless": "headless=True",
    "device": "rl_device={}",
    "cpu": "rl_device=cpu",
    "agent": "agent={}",
    "logs": "logs={}",
    "checkpoint": "checkpoint={}",
    "video_length": "capture_video_len={}",
}
_OPTIONS_OF = {
    "train": {
        "video": "capture_video=True capture_video_len=200 capture_video_freq=2000",
        "video_interval": "capture_video_freq={}",
        "max_iterations": "max_iterations={}",
        "log_interval": "log_interval={}",
    },
    "play": {
        "video": f"capture_video=True capture_video_len=200 capture_video_freq={2**53}",
        "use_last_checkpoint": f"checkpoint={LAST}",
        "real-time": "real_time=True",
    },
}
# Isaac Lab's options that have no effect here: pictures need no switch, infos are complete, and
# there is no Kit.
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
    "use_pretrained_checkpoint": "none are shipped for this library; use --checkpoint FILE",
}
_HELP = f"""{{verb}}s an agent of {{title}}.

keys:
  task=NAME               a task file, its path, or IsaacGymEnvsLite/Ant-v0
  agent=NAME              an agent file or its path; default: the task's
  checkpoint=FILE         to start from, or to play; last: the task's newest, default of play
  logs=FOLDER             folder of all trainings; default: logs
  max_iterations=N        train: rollouts, each with its updates; default: the agent file's
  log_interval=N          train: frames from one log entry to the next
  real_time=True          play: wait where steps are faster than the simulated time
  num_envs=N, seed=N, rl_device=cuda:0, headless=False, viewer=web, capture_video=True,
  task.env.episodeLength=200, ...: as for train.py
  {PREFIX}KEY=VALUE         any key of the agent file
"""


@dataclass(frozen=True, kw_only=True)
class CommandSettings:
    """The keys that training and playing have in common."""

    task: str = setting()
    """Name or path of a task file, or a task's name in Gymnasium."""
    agent: str = setting("")
    checkpoint: str = setting("")
    """File, or `last`."""
    logs: str = setting("logs")


@dataclass(frozen=True, kw_only=True)
class TrainSettings(CommandSettings):
    """The keys of `train`; a checkpoint is the start of the training."""

    max_iterations: int | None = setting(None, minimum=1)
    log_interval: int | None = setting(None, minimum=1)
    """Frames; None: the library's own."""


@dataclass(frozen=True, kw_only=True)
class PlaySettings(CommandSettings):
    """The keys of `play`."""

    real_time: bool = setting(False)


Settings = TypeVar("Settings", bound=CommandSettings)


@dataclass(frozen=True)
class Command(Generic[Settings]):
    """A command line, sorted by what its keys belong to.

    Attributes:
        settings: the command's own keys.
        task_words: `key=value` for the task, as for train.py.
        agent_words: `agent.key=value` for the agent file.
    """

    settings: Settings
    task_words: tuple[str, ...]
    agent_words: tuple[str, ...]


def read_command(settings: type[Settings], args: argparse.Namespace) -> Command[Settings]:
    """Sort the keys of a parsed command line by what they belong to.

    Args:
        settings: the keys of the verb.
        args: from `make_parser`; its words win over its options.

    Raises:
        ConfigError: a key that has no effect here, or a value that cannot be used.
    """
    known = keys_of(settings)
    own_words, task_words, agent_words = list[str](), list[str](), list[str]()
    for word in (*args.option_words, *args.words):
        key, equals, _ = word.partition("=")
        if equals and key in known:
            own_words.append(word)
        elif key.startswith(PREFIX):
            agent_words.append(word)
        else:
            _check_task_word(word, known)
            task_words.append(word)
    try:
        values: Any = OmegaConf.to_container(OmegaConf.from_dotlist(own_words))
    except YAMLError as error:
        raise ConfigError(f"{' '.join(own_words)}: a value is not valid YAML") from error
    if not values.get("task"):
        raise ConfigError("task= is missing, for example task=Cartpole; --help lists the keys")
    values["task"] = task_of_id(str(values["task"]))
    own = read_section(settings, values, where="", complete=True)
    return Command(own, tuple(task_words), tuple(agent_words))


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


def log_idle_options(args: argparse.Namespace) -> None:
    """Log the given options of Isaac Lab that have no effect."""
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


class _Option(argparse.Action):
    """Adds the words that an option stands for, or ends the command with what to use instead."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        if self.dest in _REFUSED:
            parser.exit(EXIT_USER_ERROR, f"error: {option_string}: {_REFUSED[self.dest]}\n")
        added = namespace.option_words
        if self.dest == "livestream":
            namespace.option_words = [*added, *(["viewer=web"] if values > 0 else [])]
        elif self.dest == "video":  # its words come first, so that those of --video_length win
            namespace.option_words = [*self.const.split(), *added]
        else:
            namespace.option_words = [*added, self.const.format(values)]


def make_parser(library: Library, verb: str) -> argparse.ArgumentParser:
    """Return a parser for the words of a command line and for Isaac Lab's options.

    Args:
        library: whose agents.
        verb: `train` or `play`.
    """
    parser = _Parser(
        prog=f"isaacgymenvs-lite workflows {library.name} {verb}",
        usage="%(prog)s task=<name> [key=value ...]",
        description=_HELP.format(verb=verb.capitalize(), title=library.title),
        epilog="Other options of Isaac Lab's scripts are accepted, or refused with what to use.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(option_words=[])
    parser.add_argument("words", nargs="*", metavar="key=value", help="see above")
    for name, word in (_OPTIONS | _OPTIONS_OF[verb]).items():
        nargs = None if "{}" in word else 0
        parser.add_argument(
            f"--{name}", action=_Option, nargs=nargs, const=word, help=word.replace("{}", "")
        )
    parser.add_argument(
        "--livestream", action=_Option, type=int, choices=(-1, 0, 1, 2), help="1, 2: viewer=web"
    )
    hidden = argparse.SUPPRESS
    for name in _IDLE_FLAGS:
        parser.add_argument(f"--{name}", action="store_true", help=hidden)
    for name in _IDLE_VALUES:
        parser.add_argument(f"--{name}", help=hidden)
    for name in _REFUSED:
        parser.add_argument(f"--{name}", action=_Option, nargs="?", help=hidden)
    # skrl's scripts have these two; there is one choice of each.
    parser.add_argument("--ml_framework", choices=("torch",), help=hidden)
    parser.add_argument("--algorithm", type=str.upper, choices=("PPO",), help=hidden)
    return parser
