"""What the pages tell a user to type is accepted: commands, Python, settings files, tables.

An indented block is typed into a shell; every other block names its language. A command is read
by its own parser, and a configuration is composed and checked. Nothing is trained or written.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import re
import runpy
import shlex
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from benchmarks.experiments import find_experiment
from isaacgymenvs_lite import command_line
from isaacgymenvs_lite.__main__ import COMMANDS, words_of_play
from isaacgymenvs_lite.checkpoints.policy_arguments import complete_arguments
from isaacgymenvs_lite.config import launch
from isaacgymenvs_lite.config.compose import compose, compose_task
from isaacgymenvs_lite.config.launch import read_config
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.train import split_options
from isaacgymenvs_lite.workflows.__main__ import read_command
from isaacgymenvs_lite.workflows.training import PlaySettings, TrainSettings

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

NOT_OURS = {"git", "cd", "jupyter", "ssh", "tensorboard", "."}
TORCHRUN = {"--standalone", "--nproc-per-node", "--nnodes", "--max-restarts"} | {
    f"--rdzv-{name}" for name in ("id", "backend", "endpoint")
}
# tests/tasks/test_registry.py runs it with the files of its page.
RUN_ELSEWHERE = {
    "python train.py --config-dir cfg task=SwingUp",
    "python train.py --config-dir cfg task=HumanoidDribble train=HumanoidHeadingAMP",
    "python train.py --config-dir cfg task=HumanoidDribble train=HumanoidASEHRLPPO",
}
# Files that a user has or makes, and a file of ours of the same kind where the check reads it.
USERS_FILES = {
    "/path/to/AntPPO.yaml": "cfg/train/AntPPO.yaml",
    "/IsaacGymEnvs/isaacgymenvs/cfg/task/HumanoidAMP.yaml": "cfg/task/HumanoidAMP.yaml",
    "/any/where/amp_humanoid_walk.npy": "assets/amp/motions/walk.npz",
    "/robots/g1.xml": "assets/mjcf/g1.xml",
    "/configs/my_robot.yaml": "cfg/task/RobotAMP.yaml",
    "amp_humanoid_walk.npy": "assets/amp/motions/walk.npz",
    **dict.fromkeys(
        [
            "walk1_subject1.csv",
            "dance.bvh",
            "dance.npz",
            "dance.csv",
            "trot.npz",
            "half.npz",
            "half.csv",
            "my_walk.npz",
            "my_script.py",
            "g1.yaml",
            "policy.onnx",
        ]
    ),
}
# `FILE`, `TARGET`, `<run>`: whatever the user means.
PLACEHOLDER = re.compile(r"[A-Z]+(\.\w+)?|.*<.+>.*")
FILE_NAME = re.compile(r".*\.(npy|npz|csv|bvh|ya?ml|pth|py|json|txt|onnx)")
OPTIONAL_MODULES = {"onnxruntime", "stable_baselines3"}
USERS_MODULES = {"swing_up"}
# A word of a command, and the extra that it needs.
EXTRAS = {
    "isaacgymenvs_lite.workflows.sb3": "sb3",
    "isaacgymenvs_lite.workflows.skrl": "skrl",
    "isaacgymenvs_lite.workflows.rsl_rl": "rsl-rl",
    **{"sb3": "sb3", "skrl": "skrl", "rsl_rl": "rsl-rl"},
    **{"demo": "video", "benchmarks.film": "video", "capture_video=True": "video"},
    **{"export": "export", "play_onnx.py": "export"},
    **{"hydra/sweeper=optuna": "sweep", "hydra/launcher=": "sweep", "+study=": "sweep"},
    **{"tools.clip_synthesis": "retarget", "wandb_activate=True": "wandb"},
}


@dataclass(frozen=True)
class Block:
    """Code of a page; `language` is "" where it is indented."""

    page: Path
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


def blocks_of(page: Path) -> Iterator[Block]:
    """Blocks between fences, and indented blocks after an empty line."""
    lines = page.read_text(encoding="utf-8").splitlines()
    number, is_after_gap = 0, True
    while number < len(lines):
        line, first = lines[number], number + 1
        number += 1
        if line.startswith("```"):
            end = lines.index("```", number)
            yield Block(page, first, line.strip("`") or "?", "\n".join(lines[number:end]))
            number = end + 1
        elif line.startswith("    ") and is_after_gap:
            while number < len(lines) and (not lines[number] or lines[number].startswith("    ")):
                number += 1
            yield Block(page, first, "", "\n".join(lines[first - 1 : number]))
        is_after_gap = not lines[number - 1]


def split_command(line: str) -> Iterator[tuple[str, ...]]:
    """The words of each command of a line; `a && b` are two."""
    words = shlex.split(line, comments=True)
    while "&&" in words:
        end = words.index("&&")
        yield tuple(words[:end])
        words = words[end + 1 :]
    if words:
        yield tuple(words)


def commands_of(block: Block) -> list[tuple[str, ...]]:
    lines = block.text.replace("\\\n", " ").splitlines()
    return [words for line in lines for words in split_command(line)]


def text_of(page: Path) -> str:
    """A page without the blocks between fences."""
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def inline_commands_of(page: Path) -> Iterator[tuple[str, ...]]:
    """Whole commands within sentences; `python -m module` alone only names a module."""
    for command in re.findall(
        r"`((?:python|torchrun|make|pip|isaacgymenvs-lite) [^`]+)`", text_of(page)
    ):
        if "..." not in command and not re.fullmatch(r"(python -m|\S+-lite) [\w.]+", command):
            yield from split_command(" ".join(command.split()))


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
TO_TYPE = [block for block in BLOCKS if not block.language]
PYTHON = [block for block in BLOCKS if block.language == "python"]
TYPED = {words: str(block) for block in TO_TYPE for words in commands_of(block)}
TYPED |= {words: page.name for page in PAGES for words in inline_commands_of(page)}


# --- a function for each first word of a command --------------------------------------------------


def check_python3(words: Sequence[str]) -> None:
    assert words == ("-m", "venv", ".venv")


def check_pip(words: Sequence[str]) -> None:
    assert words[0] == "install"
    rest = list(words[1:])
    while rest:
        word = rest.pop(0)
        if word == "-c":
            assert (ROOT / rest.pop(0)).is_file()
        elif word != "-e":
            package, _, extras = word.rstrip("]").partition("[")
            assert package in (".", "dist/*.whl", PYPROJECT["name"])
            assert set(extras.split(",")) - {""} <= set(PYPROJECT["optional-dependencies"])


def check_make(words: Sequence[str]) -> None:
    target, *settings = words
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(rf"^{re.escape(target)}:", makefile, re.M), f"no target {target}"
    for setting in settings:
        arguments = shlex.split(setting.removeprefix("ARGS="))
        if target == "demo":
            check_module("isaacgymenvs_lite.commands.demo", arguments)
        else:
            assert target == "train", f"make {target} {setting}: how is it checked?"
            check_train(["task=HumanoidAMP", *arguments])


def check_python(words: Sequence[str]) -> None:
    option, *rest = words
    if option == "-m":
        check_module(rest[0], rest[1:])
    elif option == "play_onnx.py":
        arguments_of(runpy.run_path, str(ROOT / option), rest)
    else:
        assert option == "train.py"
        check_train(rest)


def check_console_script(words: Sequence[str]) -> None:
    if not words:
        return
    command, *rest = words
    assert command in COMMANDS, f"{command}: no command"
    if command in ("train", "play"):
        check_train(words_of_play(rest) if command == "play" else rest)
    else:
        check_module(f"isaacgymenvs_lite.{COMMANDS[command]}", rest)


def check_torchrun(words: Sequence[str]) -> None:
    script = words.index("train.py")
    assert {option.partition("=")[0] for option in words[:script]} <= TORCHRUN
    assert "multi_gpu=True" in words
    check_train(words[script + 1 :])


def check_train(words: Sequence[str]) -> None:
    """The words compose, and pass what train.py checks before it makes a task."""
    options, overrides = split_options([with_real_file(word) for word in words])
    words = words_of_first_job(complete_arguments(overrides))
    read_config(compose(words, options.get("--config-dir")))


def words_of_first_job(words: Sequence[str]) -> list[str]:
    """Words with the first of several values; those of plugins only if the plugins are there."""
    found = []
    for override in OverridesParser.create().parse_overrides(list(words)):
        word = override.input_line or ""
        if word.startswith(("hydra", "+study=")) and not find_spec("hydra_plugins"):
            continue
        if override.is_choice_sweep():
            word = f"{override.key_or_group}={next(override.sweep_string_iterator())}"
        elif override.is_interval_sweep():
            interval: Any = override.value()
            word = f"{override.key_or_group}={interval.start}"
        found.append(word)
    return found


def with_real_file(word: str) -> str:
    """A word with a file of ours in place of a user's of the same kind; `<run>` is any text."""
    key, equals, value = re.sub("<.*?>", "x", word).rpartition("=")
    own = USERS_FILES.get(value)
    return f"{key}{equals}{ROOT / own if own else value}"


class Accepted(BaseException):
    """A command has taken its words, the argument; nothing of it has begun."""


@pytest.fixture
def nothing_begins(monkeypatch, tmp_path):
    """Commands end once their words are read; packages of extras count as installed."""
    read_settings = command_line.read_settings

    def read_only(*args):
        raise Accepted(read_settings(*args))

    monkeypatch.setattr(command_line, "read_settings", read_only)
    for method in ("parse_args", "parse_intermixed_args"):
        monkeypatch.setattr(argparse.ArgumentParser, method, ending(method))
    monkeypatch.setattr(launch, "require", lambda *_, **__: None)
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.chdir(tmp_path)


def ending(method: str) -> Callable[..., argparse.Namespace]:
    """A method of argparse's parser that ends the command, unless it has settings to read, too."""
    parse = getattr(argparse.ArgumentParser, method)

    def parse_only(parser, arguments=None, namespace=None):
        found = parse(parser, arguments, namespace)
        if namespace is None:
            raise Accepted(found)
        return found  # `run_command` reads the settings next

    return parse_only


def check_module(module: str, words: Sequence[str]) -> None:
    """The module's own parser takes the words; tasks and experiments that they name compose."""
    found = arguments_of(runpy.run_module, module, words)
    if ".workflows" in module:
        is_training = "train" in (*words[:2], module.rpartition(".")[2])
        verb = TrainSettings if is_training else PlaySettings
        settings, task_words, _ = read_command(verb, found)
        read_config(compose_task(settings.task, task_words))
    if module.startswith("benchmarks."):
        check_experiments([*getattr(found, "what", ()), *getattr(found, "targets", ())])


def arguments_of(run: Callable[..., object], program: str, words: Sequence[str]) -> Any:
    """Return what a program's own parser makes of its words."""
    argv = sys.argv
    sys.argv = [program, *words]
    try:
        with pytest.raises(Accepted) as caught:
            run(program, run_name="__main__")
    except SystemExit as end:
        pytest.fail(f"{program} ends with {end.code}")
    finally:
        sys.argv = argv
    return caught.value.args[0]


def check_experiments(words: Sequence[str]) -> None:
    words = [word for word in words if not PLACEHOLDER.fullmatch(word.rpartition("=")[2])]
    settings = [word for word in words if "=" in word]
    for word in words:
        if "=" not in word and "/" not in word:
            experiment = find_experiment(word, motion_file=__file__)
            read_config(compose([*experiment.settings, *settings]))


CHECKS = {
    "torchrun": check_torchrun,
    "python": check_python,
    "python3": check_python3,
    "isaacgymenvs-lite": check_console_script,
    "make": check_make,
    "pip": check_pip,
}


def check_command(words: Sequence[str]) -> None:
    while re.match(r"[A-Z_]+=", words[0]):  # variables of the shell
        words = words[1:]
    first, *rest = words
    assert first in (*CHECKS, *NOT_OURS), f"{first}: no command; is it ```text?"
    if first in CHECKS:
        CHECKS[first](tuple(rest))
    for name in (word.rpartition("=")[2] for word in rest):
        if FILE_NAME.fullmatch(name) and not PLACEHOLDER.fullmatch(name):
            known = name in USERS_FILES or name.startswith(("runs/", "logs/"))
            assert known or (ROOT / name).is_file(), f"{name}: no such file"


# --- tests ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_begins")
def test_every_command_is_accepted():
    refused = []
    for words, where in TYPED.items():
        if " ".join(words) not in RUN_ELSEWHERE:
            try:
                check_command(words)
            except (Exception, pytest.fail.Exception) as error:
                refused.append(f"{where} {shlex.join(words)}: {error!r}")
    assert not refused, "\n".join(refused)


@pytest.mark.usefixtures("nothing_begins")
def test_a_wrong_command_is_found():
    for command in [
        "pyhton train.py task=Ant",
        "python train.py task=Cartpol",
        "python train.py task=Ant task.env.episodeLenght=3",
        "python train.py --task Ant",
        "python train.py train=/no/such/AntPPO.yaml",
        "python train.py -m num_env=choice(1,2)",
        "isaacgymenvs-lite demos",
        "isaacgymenvs-lite demo second=3",
        "isaacgymenvs-lite check SwingUp.yaml",
        "isaacgymenvs-lite workflows sb3 train task=Ant num_env=4",
        "python -m isaacgymenvs_lite.workflows.sb3.train --task Ant --num-env 4",
        "python -m benchmarks.learning wolk --minutes 3",
        "python play_onnx.py policy.onnx --steps many",
        "make trian",
        "pip install -e .[vidoe]",
    ]:
        (words,) = split_command(command)
        with pytest.raises((AssertionError, UserError, ImportError, pytest.fail.Exception)):
            check_command(words)


def test_modules_that_are_named_can_be_run():
    named = re.compile(r"python -m ((?:isaacgymenvs_lite|benchmarks|tools)[\w.]*)")
    for module in {name for page in PAGES for name in named.findall(text_of(page))}:
        path = ROOT.joinpath(*module.split("."))
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module


def test_the_page_names_the_extra_that_a_command_needs():
    for block in TO_TYPE:
        page = block.page.read_text(encoding="utf-8")
        for words in commands_of(block):
            if words[0] != "make" and "format=torchscript" not in words:
                for extra in extras_of(words):
                    pattern = rf"\[([\w,-]+,)?{extra}(,[\w,-]+)?\]"
                    assert re.search(pattern, page), (block, words, extra)


def extras_of(words: Sequence[str]) -> set[str]:
    return {
        extra
        for word in words
        for start, extra in EXTRAS.items()
        if word == start or (start[-1] == "=" and word.startswith(start))
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_compiles_and_finds_its_imports(page):
    texts = [block.text for block in PYTHON if block.page == page]
    for node in (node for text in texts for node in ast.walk(ast.parse(text))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                find_module(alias.name)
        elif isinstance(node, ast.ImportFrom) and node.module not in USERS_MODULES:
            module = find_module(node.module or "")
            for alias in node.names:
                if not hasattr(module, alias.name):
                    find_module(f"{node.module}.{alias.name}")


def find_module(name: str) -> Any:
    library = name.partition(".")[0]
    if library in OPTIONAL_MODULES and find_spec(library) is None:
        return None
    return importlib.import_module(name)


READERS: dict[str, Callable[[str], object]] = {
    "yaml": yaml.safe_load,
    "toml": tomllib.loads,
    "xml": ElementTree.fromstring,
    "python": ast.parse,
    "text": str,
}


def test_files_of_the_pages_can_be_read():
    for block in BLOCKS:
        if block.language:
            READERS[block.language](block.text)


def test_tables_are_whole():
    """A line between the rows, or a row of another width, and the rest is drawn as text."""
    pages = "\n".join(text_of(page) for page in PAGES)
    for table in re.findall(r"(?:^\|.*\n)+", pages, re.M):
        rows = table.splitlines()
        assert re.fullmatch(r"(\|\s*:?-+:?\s*)+\|", rows[1] if len(rows) > 1 else ""), rows[0]
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) == 1, rows[0]
