"""Checks configuration files from outside cfg/ and copies them into a folder that Hydra searches.

Hydra finds files by their names in folders. This module copies a file that a command line names by
its path (`train=/path/to/AntPPO.yaml`), and the files of `--config-dir` or `--config-path`, to a
temporary folder. Hydra searches this folder first and cfg/ next.

The module also checks files that somebody else wrote. The section `hydra` of a configuration can do
what a program can: Hydra imports and calls the Python names of its callbacks, launchers and log
handlers. A file is refused here if it sets this section, names something to be imported, or reads
the environment of this process. docs/foreign_files.md has the list for users.
"""

from __future__ import annotations

import contextlib
import logging
import os.path
import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml
from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.resolvers import RESOLVERS, forbidden_resolver
from isaacgymenvs_lite.config.run_names import TRAIN_DIR
from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.paths import cfg_dir, user_path
from isaacgymenvs_lite.schema import select
from isaacgymenvs_lite.utils.yaml_file import load_yaml

log = logging.getLogger(__name__)

ROOT = "config"
"""Name of the root file."""
GROUPS = ("task", "train", "pbt")
REFUSED = "refused"
CHECKOUT_KEY = "task_checkout"
"""Root key for the folder of the task file's checkout. The value '' means no folder."""
_NAMED_BY_PATH = ("task", "train")
_SUFFIXES = (".yaml", ".yml")
_WHERE_TO = "it belongs on the command line, or into cfg/ if you wrote the file yourself"
# The section `hydra` of IsaacGymEnvs' root file; our section contains the same values.
_HARMLESS = {"output_subdir": None, "run": {"dir": "."}, "job": {"chdir": False}}
_LOGGING = ("override hydra/job_logging", "override hydra/hydra_logging")
_PACKAGE = re.compile(r"(?:\s*#.*\n)*?\s*#\s*@package\s+(.*)")
# A file's name with the folders below its group. The name may contain the choice of another group:
# ${task}.
_ENTRY = re.compile(r"(?:[\w.+-]|\$\{\w+\})+(?:/(?:[\w.+-]|\$\{\w+\})+)*")

# The top folder of a project has at least one of these entries; a package inside the folder has
# none.
_TOP_OF_A_PROJECT = (".git", "setup.py", "pyproject.toml", "assets")
# ASE's task files lack the task's name, so this table maps the end of a file's name to our task.
_TASKS_OF_ASE = {
    "heading": "HumanoidHeading",
    "location": "HumanoidLocation",
    "reach": "HumanoidReach",
    "strike": "HumanoidStrike",
    "getup": "HumanoidASEGetup",
    "getup_test": "HumanoidASEGetup",
    "perturb": "HumanoidPerturb",
    "": "HumanoidASE",
}


@dataclass(frozen=True)
class StagedFiles:
    """A command line in which names replace the paths of files.

    Attributes:
        words: the overrides.
        folder: the folder that Hydra searches first.
        refused: maps the name of each refused file in Hydra to its error. The defaults list of its
            copy contains a file below `REFUSED` that does not exist, so that a command line fails
            only if it uses the refused file.
    """

    words: list[str]
    folder: Path
    refused: dict[str, ConfigError] = field(default_factory=dict)


@contextlib.contextmanager
def staged(
    words: Sequence[str],
    config_dir: str | Path | None = None,
    root: str | Path | None = None,
    *,
    trains: bool = True,
) -> Iterator[StagedFiles]:
    """Yield a command line that Hydra understands; the copied files exist until the context ends.

    Args:
        words: overrides; `task=` and `train=` may name files by their paths.
        config_dir: a folder with more task/, train/, pbt/ and root files.
        root: a folder that replaces cfg/; files that the folder lacks come from cfg/.
        trains: whether the command line may start a training, which writes into the folder that the
            files name.

    Raises:
        ConfigError: a file does not exist, or has content that is refused from outside.
    """
    if not (config_dir or root or any(_names_file(word) for word in words)):
        yield StagedFiles(list(words), cfg_dir())
        return
    # The machines of a cluster share the working folder, but not the temporary folder.
    shared = Path.cwd() if any("=submitit_slurm" in word for word in words) else None
    with tempfile.TemporaryDirectory(prefix=".staged_", dir=shared) as folder:
        target = Path(folder)
        _write(_our_root(), target / f"{ROOT}.yaml")
        refused = dict[str, ConfigError]()
        for source in (config_dir, root):
            if source is not None:
                refused |= _stage_folder(Path(source), target)
        named = _stage_named_files(words, target)
        if trains and not any(word.lstrip("+").startswith(f"{TRAIN_DIR}=") for word in words):
            for file in target.glob("train/*.yaml"):
                run_dir = select(_read(file), "params.config.train_dir")
                path = PurePath(run_dir if isinstance(run_dir, str) else "..")
                is_below = not (path.is_absolute() or ".." in path.parts or "$" in str(path))
                if run_dir is not None and not is_below:
                    raise ConfigError(
                        f"{file.name}: {TRAIN_DIR} is {run_dir!r}, outside of the working folder;"
                        f" to write there, add {TRAIN_DIR}={run_dir} to the command line"
                    )
        yield StagedFiles(named, target, refused)


def read_yaml(path: Path) -> DictConfig:
    """Read one YAML file without its defaults list.

    If a key occurs twice, the last value counts, as in PyYAML, which ASE uses.
    """
    content = _read(path)
    if is_foreign(path):
        _check_content(content, path)
    try:  # OmegaConf reads 2e-5 as a number, PyYAML as text
        config: Any = OmegaConf.create(yaml.safe_dump(content, sort_keys=False))
        return config if content else OmegaConf.create()
    except Exception as error:  # a wrong interpolation, or a key of a wrong type
        raise ConfigError(f"{path} cannot be used: {one_line(error)}") from error


def is_foreign(path: Path) -> bool:
    """Return whether a file lies outside of this project's folder cfg/."""
    return not Path(os.path.abspath(path)).is_relative_to(cfg_dir())


# --- copying --------------------------------------------------------------------------------------


def _stage_folder(source: Path, target: Path) -> dict[str, ConfigError]:
    """Copy the root files of a folder, and all files of its groups; return the refused files."""
    if not source.is_dir():
        raise ConfigError(
            f"the configuration folder '{source}' does not exist; expected a folder that holds"
            " task/ and train/"
        )
    ours = _our_root()  # its section `hydra` replaces that of other root files
    logs = [entry for entry in ours["defaults"] if _is_about_logging(entry)]
    for file in source.glob("*.yaml"):
        content = _checked(file, group="")
        own = [entry for entry in content.get("defaults") or [] if not _is_about_logging(entry)]
        _write(content | {"hydra": ours["hydra"], "defaults": [*own, *logs]}, target / file.name)
    refused = {}
    for group in GROUPS:
        for file in (source / group).rglob("*.yaml"):
            name = file.relative_to(source)
            try:
                content = _checked(file, name.parent.as_posix())
            except ConfigError as error:  # `explain` raises it if the command line names the file
                place = name.with_suffix("").as_posix()
                refused[place] = error
                content = {"defaults": [f"/{REFUSED}/{place}"]}
            _write(content, target / name)
    return refused


def _stage_named_files(words: Sequence[str], target: Path) -> list[str]:
    """Copy the files whose paths `task=` and `train=` give; return overrides with their names."""
    typed = {word.partition("=")[0] for word in words}
    staged_words = []

    def stage(group: str, file: Path) -> None:
        name = re.sub(r"[^\w-]", "_", file.stem)  # a name in Hydra's grammar
        if file.parent != cfg_dir() / group:
            _stage_with_siblings(file, group, target / group / f"{name}.yaml", set())
        staged_words.append(f"{group}='{name}'")  # the quotes keep 2024.yaml from being a number

    for word in words:
        group, _, value = word.partition("=")
        if not _names_file(word):
            staged_words.append(word)
            continue
        file = _find(group, value)
        stage(group, file)
        if group == "task":
            beside = _train_file_beside(file)
            if beside is not None and "train" not in typed:
                log.info("train file: %s (next to the task file; train= replaces it)", beside)
                stage("train", beside)
            if CHECKOUT_KEY not in typed:
                staged_words.append(f"++{CHECKOUT_KEY}={quoted(str(checkout_of(file)))}")
    return staged_words


def _stage_with_siblings(file: Path, group: str, target: Path, done: set[Path]) -> None:
    """Copy a file, and those files of its folder that its defaults list names."""
    done.add(file)
    content = _checked(file, group)
    _write(content, target)
    for entry in content.get("defaults") or []:
        if isinstance(entry, dict):  # {env: fast} is env/fast.yaml; the user may give env=slow
            folder = str(next(iter(entry))).removeprefix("optional ")
            siblings = list(file.parent.glob(f"{folder}/*.yaml"))
        else:
            siblings = [file.with_name(f"{entry}.yaml")]
        for sibling in siblings:
            # Path.is_file would raise for a name that is too long.
            if os.path.isfile(sibling) and sibling not in done:
                name = sibling.relative_to(file.parent)
                place = PurePath(group, name).parent.as_posix()
                _stage_with_siblings(sibling, place, target.parent / name, done)


def _names_file(word: str) -> bool:
    group, _, value = word.partition("=")
    value = value.strip("'\"")
    is_path = value.endswith(_SUFFIXES) or value.startswith(("/", "./", "../", "~"))
    return group in _NAMED_BY_PATH and is_path


def _find(group: str, value: str) -> Path:
    given = user_path(value.strip("'\""))
    for candidate in (given, *(given.with_name(given.name + suffix) for suffix in _SUFFIXES)):
        if candidate.is_file():
            return candidate.resolve()
    raise ConfigError(
        f"{group}={value}: no file {given.absolute()}; give the path of a {group} file, or a name"
        f" in cfg/{group}"
    )


def quoted(text: str) -> str:
    """Return a text in the quotes that Hydra's grammar needs around blanks and commas."""
    return QuotedString(text=text, quote=Quote.single).with_quotes()


def _our_root() -> dict[Any, Any]:
    """Return cfg/config.yaml with cfg/ in its search path."""
    root = _read(cfg_dir() / f"{ROOT}.yaml")
    root["hydra"]["searchpath"] = [f"file://{cfg_dir()}"]
    return root


def _write(content: dict[Any, Any], file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")


# --- reading and checking -------------------------------------------------------------------------


def _checked(file: Path, group: str) -> dict[Any, Any]:
    """Return the checked content of a file that belongs to `group`, or to the root ('')."""
    content = _read(file)
    header = _PACKAGE.match(file.read_text(encoding="utf-8-sig"))
    own = group.replace("/", ".")
    package = header[1].strip() if header else "_group_"
    allowed = ("_group_", own, f"_global_.{own}") if own else ("_group_", "_global_")
    if package not in allowed:
        raise ConfigError(
            f"{file} has the header '# @package {package}', which names another section; expected"
            f" '{own}' or no header"
        )
    hydra = content.get("hydra", {})
    is_dict = isinstance(hydra, dict)
    if not own and is_dict and all((k, v) in _HARMLESS.items() for k, v in hydra.items()):
        content.pop("hydra", None)
    _check_content(content, file)
    defaults = content.get("defaults") or []
    for entry in defaults if isinstance(defaults, list) else [defaults]:
        _check_entry(entry, file, is_root=not own)
    # Published files lack these values, which their command line or the code of their project
    # gives.
    config = select(content, "params.config")
    if isinstance(config, dict) and "llc_config" in config and "defaults" not in content:
        config.setdefault("llc_checkpoint", "")
    task = _task_of_ase_file(file) if group == "task" and "name" not in content else None
    if task is not None:
        log.info("%s is a task file of ASE, which names no task: using task=%s", file, task)
        content.setdefault("defaults", [task, "_self_"])
        env = content.get("env")
        if isinstance(env, dict) and isinstance(env.get("numEnvs"), int):
            env["numEnvs"] = f"${{resolve_default:{env['numEnvs']},${{...num_envs}}}}"
    return content


def _read(path: Path) -> dict[Any, Any]:
    """Return the mapping in a YAML file."""
    content = load_yaml(path)
    if content is None:
        return {}
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise ConfigError(f"{path} holds a {kind}, expected a mapping of keys to values")
    return content


def _check_content(content: dict[Any, Any], path: Path) -> None:
    """Refuse settings of Hydra, names to be called, and interpolations that lead elsewhere."""
    if "hydra" in content:
        raise ConfigError(f"{path} sets 'hydra', which decides what is run; {_WHERE_TO}")
    try:
        _check_values(content, str(path))
    except RecursionError as error:
        raise ConfigError(f"{path} contains itself, or is nested too deep") from error


def _check_values(value: Any, where: str) -> None:
    if isinstance(value, str) and (found := forbidden_resolver(value)):
        raise ConfigError(
            f"{where}: '{value[:60]}' uses '{found}', which is refused in a file from outside;"
            " expected a path in the configuration, ${path.of.a.key}, or one of the functions"
            f" {', '.join(sorted(RESOLVERS))}; {_WHERE_TO}"
        )
    if isinstance(value, dict):
        for key, entry in value.items():
            if key == "_target_":
                raise ConfigError(
                    f"{where} has a key '_target_', which names code to be called; register code"
                    " in Python instead (docs/own_task.md)"
                )
            _check_values(entry, f"{where}.{key}" if ": " in where else f"{where}: {key}")
    elif isinstance(value, list):
        for entry in value:
            _check_values(entry, where)


def _check_entry(entry: Any, path: Path, is_root: bool) -> None:
    """Check that an entry of a defaults list names a file in the same group or below it."""
    if is_root and _is_about_logging(entry):
        return
    names = [entry]
    if isinstance(entry, dict) and len(entry) == 1:
        group, choice = next(iter(entry.items()))
        choices = choice if isinstance(choice, list) else [choice]
        names = [str(group).removeprefix("optional "), *(c for c in choices if c is not None)]
    for name in names:
        fits = isinstance(name, str) and _ENTRY.fullmatch(name) and ".." not in name.split("/")
        if not fits or (is_root and name.split("/")[0] == "hydra"):
            raise ConfigError(
                f"{path}: the entry '{str(entry).strip('{}')}' of its defaults list leads out of"
                " the file's group; expected the name of a file in the same folder"
            )


def _is_about_logging(entry: Any) -> bool:
    """Return whether an entry switches off a log of Hydra, as in IsaacGymEnvs' root file."""
    key, value = next(iter(entry.items())) if isinstance(entry, dict) and entry else ("", "")
    return key in _LOGGING and value in ("none", "disabled")


# --- the checkout of a task file that is named by its path ------------------------------------
#
# Task files of IsaacGymEnvs, of ASE and of their forks name clips, models and train files by paths
# in their checkout:
#
#     <checkout>/<package>/cfg/task/<task>.yaml       clips in assets/amp/motions (IsaacGymEnvs)
#     <checkout>/<package>/cfg/train/<task>PPO.yaml
#     <checkout>/cfg/task/<task>.yaml                 the same without a package (this project)
#     <checkout>/<package>/data/cfg/<task>.yaml       clips in <package>/data/motions (ASE)
#
# The checkout of any other task file is the file's folder.


def checkout_of(task_file: Path) -> Path:
    """Return the checkout of the task file at an absolute path."""
    folder = task_file.parent
    if _is_in_ase(task_file):
        return folder.parents[2]
    if (folder.parent.name, folder.name) != ("cfg", "task"):
        return folder
    package = folder.parents[1]

    def is_top(place: Path) -> bool:
        return any((place / name).exists() for name in _TOP_OF_A_PROJECT)

    return package.parent if is_top(package.parent) and not is_top(package) else package


def _train_file_beside(task_file: Path) -> Path | None:
    """Return the file `../train/<task>PPO.yaml` relative to a task file, or None without it."""
    beside = task_file.parent.with_name("train") / f"{task_file.stem}PPO.yaml"
    return beside if task_file.parent.name == "task" and beside.is_file() else None


def _task_of_ase_file(task_file: Path) -> str | None:
    """Return our task if the file is a task file of ASE, otherwise None."""
    if not _is_in_ase(task_file):
        return None
    return next(task for end, task in _TASKS_OF_ASE.items() if task_file.stem.endswith(end))


def clip_folders(checkout: Path, name: str) -> list[Path]:
    """Return the folders of a checkout that may contain a clip or dataset of this name.

    The list is empty if the name leads upwards (`../..`).
    """
    if ".." in Path(name).parts:
        return []
    of_ase = [folder / "motions" for folder in _data_folders(checkout)]
    return [checkout, checkout / "assets" / "amp" / "motions", *of_ase]


def model_folders(checkout: Path, root: str) -> list[Path]:
    """Return the folders of a checkout that may contain a model.

    `root` is the `assetRoot` of the task file, or '' without one. In IsaacGymEnvs the `assetRoot`
    is relative to the folder of the tasks (`../../assets`), in ASE to the checkout
    (`ase/data/assets`).
    """
    parts = [part for part in Path(root).parts if part != ".."]
    named = [checkout.joinpath(*parts)] if parts and not Path(root).is_absolute() else []
    of_ase = [folder / "assets" for folder in _data_folders(checkout)]
    return list(dict.fromkeys([*named, checkout / "assets", *of_ase]))


def _is_in_ase(task_file: Path) -> bool:
    folder = task_file.parent
    return (folder.parent.name, folder.name) == ("data", "cfg") and len(folder.parents) > 2


def _data_folders(checkout: Path) -> list[Path]:
    """Return the folders `<package>/data` of ASE or a fork."""
    return sorted(cfg.parent for cfg in checkout.glob("*/data/cfg") if cfg.is_dir())
