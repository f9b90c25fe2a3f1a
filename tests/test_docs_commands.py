"""What the pages tell a user to type is accepted: commands, file names, Python, YAML, tables.

Commands are parsed and checked as far as they go before anything is trained, made or written. A
block without a language is something to type: shell commands, or Python that begins with an import.
Everything else names its language (```text).
"""

from __future__ import annotations

import argparse
import ast
import importlib
import itertools
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
from types import ModuleType
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
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.train import split_options
from isaacgymenvs_lite.workflows.command import PlaySettings, TrainSettings, read_command

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
# Whoever begins reads these from above, and types what is there.
FIRST_PAGES = ("README.md", "docs/getting_started.md")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

# Not ours, and known to whoever types them.
SYSTEM = {"git", "cd", "jupyter", "ssh", "tensorboard"}
TORCHRUN = {"--standalone", "--nproc-per-node", "--nnodes", "--max-restarts"} | {
    f"--rdzv-{name}" for name in ("id", "backend", "endpoint")
}
ACTIVATE = (".", ".venv/bin/activate")
# Commands about files that only the page has.
RUN_ELSEWHERE = {
    "python train.py --config-dir cfg task=SwingUp": "tests/tasks/test_registry.py",
}
# What a user has, or makes by the commands: nothing of the repository.
USERS_FILES = {
    "/path/to/AntPPO.yaml": "cfg/train/AntPPO.yaml",
    "/IsaacGymEnvs/isaacgymenvs/cfg/task/HumanoidAMP.yaml": "cfg/task/HumanoidAMP.yaml",
    "/any/where/amp_humanoid_walk.npy": "assets/amp/motions/walk.npz",
    "/robots/g1.xml": "assets/mjcf/g1.xml",
    "/configs/my_robot.yaml": "cfg/task/RobotAMP.yaml",
    "walk1_subject1.csv": None,
    "amp_humanoid_walk.npy": "assets/amp/motions/walk.npz",
    **dict.fromkeys(
        (
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
        )
    ),
}
USERS_FOLDERS = ("runs/", "logs/")
# `FILE`, `TARGET`, `<run>`: whatever the user means.
PLACEHOLDER = re.compile(r"[A-Z]+(\.\w+)?|.*<.+>.*")
FILE_NAME = re.compile(r".*\.(npy|npz|csv|bvh|ya?ml|pth|py|json|txt|onnx)")
USERS_MODULES = {"swing_up"}
OPTIONAL_MODULES = {"onnxruntime", "stable_baselines3"}
# What a command needs beside the package.
EXTRAS = {
    "isaacgymenvs_lite.workflows.sb3": "sb3",
    "isaacgymenvs_lite.workflows.skrl": "skrl",
    "isaacgymenvs_lite.workflows.rsl_rl": "rsl-rl",
    **{"sb3": "sb3", "skrl": "skrl", "rsl_rl": "rsl-rl"},  # the command workflows
    "isaacgymenvs_lite.demo": "video",
    "isaacgymenvs_lite.export": "export",
    "play_onnx.py": "export",
    "isaacgymenvs_lite.report": "report",
    "isaacgymenvs_lite.motion.plot": "report",
    "isaacgymenvs_lite.motion.strip": "report",
    "tools.clip_synthesis": "retarget",
    "benchmarks.curves": "docs",
    "benchmarks.film": "video",
    "capture_video=True": "video",
    "hydra/sweeper=optuna": "sweep",
    "hydra/launcher=": "sweep",
    "+study=": "sweep",
    "wandb_activate=True": "wandb",
}


@dataclass(frozen=True)
class Block:
    """Code of a page; `language` is "" where it is indented."""

    page: Path
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{name_of(self.page)}:{self.line}"

    @property
    def is_python(self) -> bool:
        return self.language == "python" or (
            not self.language and self.text.startswith(("import ", "from "))
        )


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks_of(page: Path) -> Iterator[Block]:
    """Blocks between fences, and those that are indented after an empty line."""
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
            text = "\n".join(line.removeprefix("    ") for line in lines[first - 1 : number])
            yield Block(page, first, "", text.rstrip())
        is_after_gap = not lines[number - 1]


def commands_of(block: Block) -> Iterator[tuple[str, ...]]:
    """The words of each command of a block; `a && b` are two."""
    for line in block.text.replace("\\\n", " ").splitlines():
        yield from split_command(line)


def split_command(line: str) -> Iterator[tuple[str, ...]]:
    words = shlex.split(line, comments=True)
    while "&&" in words:
        end = words.index("&&")
        yield tuple(words[:end])
        words = words[end + 1 :]
    if words:
        yield tuple(words)


def inline_commands_of(page: Path) -> Iterator[tuple[str, ...]]:
    """Whole commands within the text; `python -m module`, `python -m module ...` only name one."""
    for command in re.findall(r"`((?:python|make|pip) [^`]+)`", without_fences(page)):
        if not re.fullmatch(r"python -m [\w.]+( \.\.\..*)?", command):
            yield from split_command(" ".join(command.removesuffix("...").split()))


def without_fences(page: Path) -> str:
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
TO_TYPE = [block for block in BLOCKS if not block.language and not block.is_python]
TYPED = {words: str(block) for block in TO_TYPE for words in commands_of(block)}
TYPED |= {words: name_of(page) for page in PAGES for words in inline_commands_of(page)}


# What each first word of a command means.


def check_system(words: Sequence[str]) -> None:
    del words


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
            assert package in (".", PYPROJECT["name"])
            assert set(extras.split(",")) - {""} <= set(PYPROJECT["optional-dependencies"])


def check_make(words: Sequence[str]) -> None:
    target, *settings = words
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(rf"^{re.escape(target)}:", makefile, re.M), f"no target {target}"
    for setting in settings:
        assert setting.startswith("ARGS=")
        arguments = shlex.split(setting.removeprefix("ARGS="))
        if target == "demo":
            check_module("isaacgymenvs_lite.demo", arguments)
        else:
            assert target == "train", f"make {target} ARGS=...: how is it checked?"
            check_train(["task=HumanoidAMP", *arguments])


def check_python(words: Sequence[str]) -> None:
    option, *rest = words
    if rest[:1] == ["isaacgymenvs_lite"] and option == "-m":
        check_console_script(rest[1:])
    elif option == "-m":
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
    options = list(itertools.takewhile(lambda word: word.startswith("--"), words))
    script, *rest = words[len(options) :]
    assert script == "train.py"
    assert {option.partition("=")[0] for option in options} <= TORCHRUN
    assert "multi_gpu=True" in rest
    if not any(word.startswith("resume=") for word in rest):
        check_train(rest)


def check_train(words: Sequence[str]) -> None:
    """The words compose, and pass what train.py checks before it makes a task."""
    options, overrides = split_options([with_real_file(word) for word in words])
    overrides = complete_arguments(overrides)
    check_config(compose(words_of_first_job(overrides), options.get("--config-dir")))


def words_of_first_job(words: Sequence[str]) -> list[str]:
    """Words with the first of several values; those of plugins only if the plugins are there."""
    found = []
    for word, override in zip(
        words, OverridesParser.create().parse_overrides(list(words)), strict=True
    ):
        if word.startswith(("hydra", "+study=")) and not find_spec("hydra_plugins"):
            continue
        if override.is_choice_sweep():
            word = f"{override.key_or_group}={next(override.sweep_string_iterator())}"
        elif override.is_interval_sweep():
            word = f"{override.key_or_group}={override.value().start}"
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
    """`python -m module words` is taken by its own parser, and so is what the words name."""
    found = arguments_of(runpy.run_module, module, words)
    if ".workflows" in module:
        is_training = "train" in (*words[:2], module.rpartition(".")[2])
        command = read_command(TrainSettings if is_training else PlaySettings, found)
        check_config(compose_task(command.settings.task, command.task_words))
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
    """Experiments of `benchmarks` compose, with the settings beside them."""
    words = [word for word in words if not PLACEHOLDER.fullmatch(word.rpartition("=")[2])]
    settings = [word for word in words if "=" in word]
    for word in words:
        if "=" not in word and "/" not in word:
            experiment = find_experiment(word, motion_file=__file__)
            check_config(compose([*experiment.settings, *settings]))


CHECKS = {
    "torchrun": check_torchrun,
    "python": check_python,
    "python3": check_python3,
    "isaacgymenvs-lite": check_console_script,
    "make": check_make,
    "pip": check_pip,
    ".": lambda words: check_system(words),
    **dict.fromkeys(SYSTEM, check_system),
}


def check_file_name(word: str) -> None:
    """A file that is named is there, or known to be a user's."""
    if FILE_NAME.fullmatch(word) and not PLACEHOLDER.fullmatch(word):
        known = word in USERS_FILES or word.startswith(USERS_FOLDERS)
        assert known or (ROOT / word).is_file(), f"{word}: no such file"


def check_command(words: Sequence[str]) -> None:
    first, *rest = itertools.dropwhile(re.compile(r"[A-Z_]+=").match, words)
    assert first in CHECKS, f"{first}: no command; is it ```text?"
    CHECKS[first](tuple(rest))
    for word in rest:
        check_file_name(word.rpartition("=")[2])


@pytest.mark.usefixtures("nothing_begins")
@pytest.mark.parametrize("words", TYPED, ids=lambda words: f"{TYPED[words]} {shlex.join(words)}")
def test_a_command_is_accepted(words):
    if " ".join(words) not in RUN_ELSEWHERE:
        check_command(words)


@pytest.mark.usefixtures("nothing_begins")
@pytest.mark.parametrize(
    "command",
    [
        "pyhton train.py task=Ant",
        "python train.py task=Cartpol",
        "python train.py task=Ant task.env.episodeLenght=3",
        "python train.py --task Ant",
        "python train.py train=/no/such/AntPPO.yaml",
        "python train.py -m task=Cartpol seed=1,2",
        "python train.py -m num_env=choice(1,2)",
        "python -m isaacgymenvs_lite.demos",
        "isaacgymenvs-lite demos",
        "isaacgymenvs-lite train task=Cartpol",
        "python -m isaacgymenvs_lite.demo second=3",
        "python -m isaacgymenvs_lite.check SwingUp.yaml",
        "python -m isaacgymenvs_lite.workflows.sb3.train --task Ant --num-env 4",
        "python -m isaacgymenvs_lite.workflows.sb3.train --task Ant task.env.nmuEnvs=4",
        "python -m isaacgymenvs_lite.workflows sb3 train task=Ant num_env=4",
        "python -m isaacgymenvs_lite.workflows sb3 play task=Ant max_iterations=4",
        "python -m isaacgymenvs_lite.workflows sbb train task=Ant",
        "python -m benchmarks.learning wolk --minutes 3",
        "python play_onnx.py",
        "python play_onnx.py policy.onnx --steps many",
        "python play_onnx.py policy.onnx --command 1",
        "make trian",
        "make demo ARGS=policy=[walk]",
        "pip install -e .[vidoe]",
    ],
)
def test_a_wrong_command_is_found(command):
    (words,) = split_command(command)
    with pytest.raises((AssertionError, UserError, ImportError, pytest.fail.Exception)):
        check_command(words)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_modules_that_are_named_can_be_run(page):
    for module in re.findall(
        r"python -m ((?:isaacgymenvs_lite|benchmarks|tools)[\w.]*)", without_fences(page)
    ):
        path = ROOT.joinpath(*module.split("."))
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module


@pytest.mark.parametrize("block", TO_TYPE, ids=str)
def test_the_page_names_the_extra_that_a_command_needs(block):
    page = block.page.read_text(encoding="utf-8")
    for words in commands_of(block):
        for word in words:
            for start, extra in EXTRAS.items():
                if word.startswith(start) and "format=torchscript" not in words:
                    assert re.search(rf"\[([\w,-]+,)?{extra}(,[\w,-]+)?\]", page), (word, extra)


@pytest.mark.parametrize("name", FIRST_PAGES)
def test_the_environment_is_activated_before_it_is_used(name):
    commands = [
        words for block in TO_TYPE if name_of(block.page) == name for words in commands_of(block)
    ]
    firsts = [words[0] for words in commands]
    assert {"python", "make"} <= set(firsts)
    begin = commands.index(ACTIVATE)
    assert not {"python", "pip", "tensorboard"} & set(firsts[:begin]), "before activation"


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.is_python], ids=str)
def test_python_compiles_and_finds_its_imports(block):
    for node in ast.walk(ast.parse(block.text)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                find_module(alias.name)
        elif isinstance(node, ast.ImportFrom):
            module = find_module(node.module or "")
            for alias in node.names if module else ():
                assert hasattr(module, alias.name) or find_module(f"{node.module}.{alias.name}")


def find_module(name: str) -> ModuleType | None:
    if name in USERS_MODULES:
        return None
    if name.partition(".")[0] in OPTIONAL_MODULES:
        return pytest.importorskip(name)
    return importlib.import_module(name)


READERS = {
    "yaml": yaml.safe_load,
    "toml": tomllib.loads,
    "xml": ElementTree.fromstring,
    "python": ast.parse,
    "text": str,
}


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language], ids=str)
def test_files_of_the_pages_can_be_read(block):
    READERS[block.language](block.text)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_tables_are_whole(page):
    """A line between the rows, or a row of another width, and the rest is drawn as text."""
    for table in re.findall(r"(?:^\|.*\n)+", without_fences(page), re.M):
        rows = table.splitlines()
        assert re.fullmatch(r"(\|\s*:?-+:?\s*)+\|", rows[1] if len(rows) > 1 else ""), rows[0]
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) == 1, rows[0]


def test_console_commands_are_on_a_page_and_exist():
    pages = " ".join(page.read_text(encoding="utf-8") for page in PAGES)
    for name, target in PYPROJECT["scripts"].items():
        assert f"`{name}" in pages
        module, _, function = target.partition(":")
        assert callable(getattr(importlib.import_module(module), function))
