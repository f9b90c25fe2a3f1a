"""Trains or plays an agent of sb3, skrl or rsl_rl: isaacgymenvs-lite workflows sb3 train.

    isaacgymenvs-lite workflows sb3 train task=Ant num_envs=64 agent.ppo.gamma=0.98
    isaacgymenvs-lite workflows sb3 play task=Ant
    python -m isaacgymenvs_lite.workflows.sb3.train --task Ant --num_envs 64

A key belongs to the command, to the agent file (prefix `agent.`) or to the task. A key of the task
means the same as in train.py. The option --help after `sb3 train` lists the keys. The options of
Isaac Lab's scripts can replace keys.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any, NoReturn, TypeVar

from isaacgymenvs_lite.command_line import log_messages, read_settings
from isaacgymenvs_lite.errors import (
    EXIT_INTERRUPTED,
    EXIT_USER_ERROR,
    ConfigError,
    UserError,
    suggest,
    unknown,
)
from isaacgymenvs_lite.gymnasium_ids import task_of_id
from isaacgymenvs_lite.schema import keys_of
from isaacgymenvs_lite.utils.optional_packages import require
from isaacgymenvs_lite.workflows.library import LIBRARIES, PREFIX
from isaacgymenvs_lite.workflows.training import (
    LAST,
    CommandSettings,
    PlaySettings,
    TrainSettings,
    play,
    train,
)

VERBS = ("train", "play")
# Keys of cfg/config.yaml that also apply to agents of other libraries.
_TASK_KEYS = {
    *("task", "seed", "num_envs", "torch_deterministic"),
    *("sim_device", "rl_device", "pipeline", "num_threads"),
    *("headless", "force_render", "viewer", "viewer_port"),
    *("capture_video", "capture_video_freq", "capture_video_len", "capture_video_envs"),
    *("physics_engine", "solver_type", "num_subscenes", "graphics_device_id"),
}
# Maps Isaac Lab's options to the `key=value` arguments that replace them; {} is the option's value.
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
        "video_interval": "capture_video_freq={}",
        "max_iterations": "max_iterations={}",
        "log_interval": "log_interval={}",
    },
    "play": {"use_last_checkpoint": f"checkpoint={LAST}", "real-time": "real_time=True"},
}
# Control steps from one video of --video to the next in a training; `play` records one video.
_VIDEO_EVERY = {"train": 2000, "play": 2**53}
# Options of Isaac Lab without effect, because cameras need no switch, infos are always complete,
# and Isaac Sim's Kit is not used.
_IDLE_FLAGS = (
    *("enable_cameras", "keep_all_info", "disable_fabric", "export_io_descriptors"),
    *("verbose", "info"),
)
_IDLE_VALUES = ("kit_args", "experience", "rendering_mode")
_HELP = f"""{{verb}}s an agent of {{library}}.

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

Settings = TypeVar("Settings", bound=CommandSettings)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train or play an agent as the command line says; return the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or {"-h", "--help"} & set(words[:2]):
        sys.stdout.write(f"libraries: {', '.join(LIBRARIES)}\n\n{__doc__}")
        return 0
    name, verb = (*words, "")[:2]
    for what, given, choices in (("library", name, LIBRARIES), ("verb", verb, VERBS)):
        if given not in choices:
            sys.stderr.write(f"error: {unknown(what, given, choices)}\n")
            return EXIT_USER_ERROR
    # rsl_rl imports GitPython; this import fails if git is not installed.
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    parser = make_parser(name, verb)
    args = parser.parse_intermixed_args(words[2:])
    log_messages()
    try:
        require(LIBRARIES[name], parser.prog)
        if verb == "train":
            train(name, *read_command(TrainSettings, args))
        else:
            play(name, *read_command(PlaySettings, args))
    except UserError as error:
        parser.exit(EXIT_USER_ERROR, f"error: {error}\n")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return 0


def read_command(
    settings: type[Settings], args: argparse.Namespace
) -> tuple[Settings, list[str], list[str]]:
    """Divide `key=value` arguments among command, task and agent file; they override options.

    Returns:
        The command's keys, the task's arguments, and the agent file's arguments.

    Raises:
        ConfigError: a key has no effect on another library's agent, or a value cannot be used.
    """
    known = keys_of(settings)
    own_words, task_words, agent_words = list[str](), list[str](), list[str]()
    for word in (*args.video, *args.option_words, *args.words):
        key, _, value = word.partition("=")
        path = key.lstrip("+~")
        if key in known and key != word:
            own_words.append(f"task={task_of_id(value)}" if key == "task" else word)
        elif key.startswith(PREFIX):
            agent_words.append(word)
        elif path.partition(".")[0] in _TASK_KEYS and path != "task":
            task_words.append(word)
        else:
            keys = ", ".join(sorted(known))
            raise ConfigError(
                f"{word}: this setting does not apply to another library's agent"
                f"{suggest(path.partition('.')[0], {*known, *_TASK_KEYS})}; expected {keys},"
                f" {PREFIX}key=value, or a key of the task such as task.env.numEnvs"
            )
    if not any(word.startswith("task=") for word in own_words):
        raise ConfigError("task= is missing, for example task=Cartpole; --help lists the keys")
    return read_settings(settings, own_words), task_words, agent_words


class _Parser(argparse.ArgumentParser):
    """An argument parser that reports a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        if message.startswith("unrecognized arguments:"):
            known = [name for action in self._actions for name in action.option_strings]
            message += suggest(message.split()[2].partition("=")[0], known)
        self.exit(EXIT_USER_ERROR, f"error: {message}; --help lists the options\n")


def make_parser(library: str, verb: str) -> argparse.ArgumentParser:
    """Return a parser of a command line's `key=value` arguments and Isaac Lab's options."""
    parser = _Parser(
        prog=f"isaacgymenvs-lite workflows {library} {verb}",
        usage="%(prog)s task=<name> [key=value ...]",
        description=_HELP.format(verb=verb.capitalize(), library=library),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(option_words=[])
    parser.add_argument("words", nargs="*", metavar="key=value", help="see above")
    add = parser.add_argument
    for name, word in (_OPTIONS | _OPTIONS_OF[verb]).items():
        shared: Any = {"dest": "option_words", "help": word.replace("{}", "")}
        if "{}" in word:
            add(f"--{name}", action="append", type=word.format, metavar="VALUE", **shared)
        else:
            add(f"--{name}", action="append_const", const=word, **shared)
    video = ["capture_video=True", "capture_video_len=200"]
    video.append(f"capture_video_freq={_VIDEO_EVERY[verb]}")
    add("--video", action="store_const", const=video, default=[], help=" ".join(video))
    add("--livestream", dest="option_words", action="append", type=_livestream, metavar="N")
    for name in _IDLE_FLAGS:
        add(f"--{name}", action="store_true", help=argparse.SUPPRESS)
    for name in _IDLE_VALUES:
        add(f"--{name}", help=argparse.SUPPRESS)
    # Isaac Lab's scripts for skrl have two options for which this command supports one value each.
    add("--ml_framework", choices=("torch",), help=argparse.SUPPRESS)
    add("--algorithm", type=str.upper, choices=("PPO",), help=argparse.SUPPRESS)
    return parser


def _livestream(value: str) -> str:
    if value not in ("-1", "0", "1", "2"):
        raise argparse.ArgumentTypeError(f"invalid choice: {value} (choose from -1, 0, 1, 2)")
    return f"viewer={'web' if int(value) > 0 else ''}"


if __name__ == "__main__":
    sys.exit(main())
