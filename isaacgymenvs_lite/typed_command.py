"""Builds the commands that play or resume a run from the command that started it."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "isaacgymenvs_lite"
CONSOLE_SCRIPT = "isaacgymenvs-lite"
"""The program that pip installs with the package; its first argument is a command."""
_TRAIN = f"{PACKAGE}.train"
_NUM_PLAYED = 16
# The command that plays a policy repeats these root keys and all keys of task and train.
_KEPT_KEYS = ("rl_device", "task_checkout")
# Hydra's options for folders and files; each of these options has a value.
_KEPT_OPTIONS = ("--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn")


@dataclass(frozen=True)
class TypedCommand:
    """A command line of train.py.

    Attributes:
        program: the text before the settings, for example `python train.py`.
        words: the settings as the user wrote them; empty if a program composed the configuration.
        is_job: whether the command ran a job of a sweep, after which other jobs may have run.
    """

    program: tuple[str, ...] = ("python", "-m", _TRAIN)
    words: tuple[str, ...] = ()
    is_job: bool = False

    @classmethod
    def of_this_process(cls) -> TypedCommand:
        """Return the command line in `sys.argv`."""
        return cls(_program(), tuple(sys.argv[1:]))

    def play(self, task: str, checkpoint: Path, *, is_newest: bool = True) -> str:
        """Return the shell command that plays a checkpoint of the run.

        The task is `task` if the settings lack `task=`. The command calls the newest checkpoint
        `last`.
        """
        typed = {_key(word): word for word in self.words if _key(word) in ("task", "train")}
        files = [typed.get("task", f"task={task}")]
        if typed.get("train", "") not in ("", f"train={files[0].partition('=')[2]}PPO"):
            files.append(typed["train"])
        settings = [
            word
            for word in self.words
            if _key(word).startswith(("task.", "train.")) or _key(word) in _KEPT_KEYS
        ]
        named = "last" if is_newest and not self.is_job else checkpoint
        played = ["test=True", f"checkpoint={named}", f"num_envs={_NUM_PLAYED}"]
        kept = _kept_options(self.words)
        return shlex.join([*self.program, *files, *kept, *settings, *played])

    def resume(self, run: Path, num_processes: int = 1) -> str:
        """Return the shell command that resumes a run; several processes need torchrun."""
        words = [*self.program, f"resume={run}"]
        if num_processes > 1:
            start = ["torchrun", "--standalone", f"--nproc-per-node={num_processes}"]
            program = words[1:] if words[0] == _python() else ["--no-python", *words]
            words = [*start, *program, "multi_gpu=True"]
        return shlex.join(words)


def _key(word: str) -> str:
    """Return the key of an override, `task.env.x` for `+task.env.x=1`."""
    return word.partition("=")[0].lstrip("+~")


def package_command(*words: str) -> str:
    """Return the shell command for a command of this package, for example `check FILE`."""
    is_found = _finds_own(CONSOLE_SCRIPT)
    program = [CONSOLE_SCRIPT] if is_found else [_python(), "-m", PACKAGE]
    return shlex.join([*program, *words])


def words_of_job(typed: Sequence[str], job: Sequence[str]) -> list[str]:
    """Return the settings of one job of a sweep (`--multirun`) as the user could write them.

    Args:
        typed: the arguments of the command line, which include those that sweep over values.
        job: Hydra's overrides of the job, in which names replace the paths of files.
    """
    files = {_key(word): word for word in typed if word.endswith((".yaml", ".yml"))}
    settings = [word for word in job if not word.startswith("++task_checkout=")]
    return [*_kept_options(typed), *(files.get(_key(word), word) for word in settings)]


def _kept_options(words: Sequence[str]) -> list[str]:
    """Return the options for folders and files, each followed by its value."""
    kept, rest = list[str](), iter(words)
    for word in rest:
        option, _, value = word.partition("=")
        if option in _KEPT_OPTIONS:
            kept += [word] if value else [word, next(rest, "")]
    return kept


def _program() -> tuple[str, ...]:
    """Return the command that started this process, without its settings."""
    # sys.argv[0] is only the path of the module, but orig_argv has the command as the user wrote
    # it.
    before = sys.orig_argv[: max(0, len(sys.orig_argv) - len(sys.argv[1:]))]
    *_, first, second, third = ["", "", "", *before]
    if (first, second) == ("-m", PACKAGE):
        return (_python(), first, second, third)
    if Path(second).name == CONSOLE_SCRIPT:
        return (_shortest(second), third)
    script, spec = sys.argv[0], getattr(sys.modules["__main__"], "__spec__", None)
    if spec is not None:
        return (_python(), "-m", spec.name.removesuffix(".__main__"))
    if script.endswith(".py"):
        return (_python(), script)
    if shutil.which(Path(script).name) is None or not Path(script).is_file():
        return (_python(), "-m", _TRAIN)  # python -c, or a program of the user
    return (_shortest(script),)


def _shortest(script: str) -> str:
    """Return the name of a program if a shell finds the program by this name, else its path."""
    found = shutil.which(Path(script).name)
    return Path(script).name if found is not None and Path(found) == Path(script) else script


def _finds_own(program: str) -> bool:
    """Return whether the program that a shell finds by this name belongs to this environment."""
    found = shutil.which(program)
    return found is not None and Path(found).parent == Path(sys.executable).parent


def _python() -> str:
    """Return `python` if a shell finds this interpreter under this name, else its shortest path."""
    if _finds_own("python"):
        return "python"
    own = Path(sys.executable)
    return str(own.relative_to(Path.cwd())) if own.is_relative_to(Path.cwd()) else str(own)
