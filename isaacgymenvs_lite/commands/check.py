"""Checks a task file, a train file or the installation, but does not train.

    isaacgymenvs-lite check FILE.yaml [task=<name>] [key=value ...]
    isaacgymenvs-lite check                    # prints versions and what works, for an issue

FILE is a path, or the name of a file in cfg/train or cfg/task. A train file is checked with the
task that `task=` names, or with the task whose name begins the file name. The command lists the
algorithm, the network, the samples and epochs, keys without effect, and adapted values. Like
train.py, it reports a mistake in one line and returns exit code 2. Files of published tasks that
this project lacks and train files of unknown tasks are mistakes, too. If the class of a task is
unknown, `task.env` is not checked.
"""

from __future__ import annotations

import argparse
import copy
import logging
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf, flag_override

from isaacgymenvs_lite.config.compose import ANY_TRAIN_FILE, compose, missing_task
from isaacgymenvs_lite.config.launch import CheckedConfig, read_config
from isaacgymenvs_lite.config.rl_games_settings import UNREAD_KEYS
from isaacgymenvs_lite.config.staging import is_foreign, read_yaml
from isaacgymenvs_lite.config.train_files import compose_file
from isaacgymenvs_lite.config.train_params import (
    check_env_name,
    checkpoint_in_file,
    prepare_train_params,
)
from isaacgymenvs_lite.errors import EXIT_USER_ERROR, ConfigError, UserError, suggest
from isaacgymenvs_lite.paths import PARTS, cfg_dir, user_path
from isaacgymenvs_lite.schema import leaves, plain, select

EXIT_DOES_NOT_WORK = 1
# Maps tasks to algorithms, for train files whose names contain no task, for example ASE's train
# files.
_TASKS_OF_ALGORITHMS = {
    "HumanoidAMP": ("amp", "amp_continuous", "amp_agent"),
    "HumanoidASE": ("ase", "gen_amp", "hrl", "hrl_continuous"),
}
_DEFAULT_NAME = re.compile(r"\$\{resolve_default:\s*['\"]?([\w-]+)")
_NO_EFFECT = "no effect here"
_GROUPS = {"params": "train", "env": "task", "name": "task", "sim": "task"}
# Keys of a task that only Isaac Gym's PhysX, importer or viewer read.
_UNREAD_TASK_KEYS = (
    *("env.envSpacing", "env.enableDebugVis", "env.enableCameraSensors", "env.renderFPS"),
    *("env.plane.restitution", "sim.num_client_threads", "sim.flex"),
)
# Prefixes that the list of keys omits; a longer prefix comes before a shorter prefix.
_SECTIONS = ("task.env.", "task.", "train.params.config.", "train.params.network.", "train.params.")
_GPU = "cuda:0"
_ALGORITHM = re.compile(r"(?:PPO|SAC)\w*$")


def main(arguments: Sequence[str] | None = None) -> int:
    """Check the file in the command line, or the installation; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="isaacgymenvs-lite check",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", nargs="?", help="a task or train file, or its name")
    parser.add_argument("settings", nargs="*", default=[], metavar="key=value")
    args = parser.parse_args(arguments)
    if args.file is None:
        from isaacgymenvs_lite.commands.installation import describe_installation  # torch, MuJoCo

        lines, works = describe_installation()
        sys.stdout.write("\n".join([*lines, ""]))
        return 0 if works else EXIT_DOES_NOT_WORK
    try:
        sys.stdout.write("\n".join([*describe(args.file, args.settings), ""]))
    except UserError as error:
        parser.exit(EXIT_USER_ERROR, f"error: {error}\n")
    return 0


def describe(file: str, overrides: Sequence[str] = ()) -> list[str]:
    """Return the lines of a description of a task or train file.

    Args:
        file: path or name of the file.
        overrides: settings as on train.py's command line.

    Raises:
        UserError: train.py would refuse the file.
    """
    path = _find(file)
    with _log_lines() as logged:
        _refuse_missing_task(path, overrides)
        kind, content = _kind(path)
        words = [f"{kind}={path}", *overrides]
        guessed = kind == "train" and not any(word.startswith("task=") for word in overrides)
        if guessed:
            words.insert(0, f"task={_task_of(path, content)}")
        has_train = kind == "train" or any(word.startswith("train=") for word in overrides)
        if not has_train:
            train = _train_file_of(path, str(content.get("name") or ""))
            words.append(f"train={train or ANY_TRAIN_FILE}")
            has_train = train is not None
        config = read_config(compose(words))
        task = str(config.tree["task"]["name"])
        if kind == "task":
            lines = [f"{path.name}: a task file, of the task {task}"]
        else:
            hint = "; task=<name> checks it with another" if guessed else ""
            with_task = next(word for word in reversed(words) if word.startswith("task="))
            lines = [f"{path.name}: a train file, checked with {with_task}{hint}"]
        from isaacgymenvs_lite.tasks.registry import is_task  # torch, as in `_describe_composed`

        known = kind == "train" or is_task(task)
        if known:
            lines += _describe_composed(config, kind, has_train)
        else:
            lines.append(
                f"the class of '{task}' is not here, so that the keys of task.env are not checked;"
                " install the package that has it, or register it in a script (docs/own_task.md)"
            )
            if unread := keys_without_effect(config.tree):
                lines.append(f"{_NO_EFFECT}: {', '.join(unread)}")
    lines += [f"note: {line}" for line in dict.fromkeys(logged)]
    checked = "it" if known else "the rest of it"
    if any(line.startswith((_NO_EFFECT, "note: nothing reads")) for line in lines):
        return [*lines, f"{checked} can be used; the keys without effect are named above"]
    return [*lines, f"nothing is wrong with {checked}"]


def _describe_composed(config: CheckedConfig, kind: str, has_train: bool) -> list[str]:
    # torch, MuJoCo and rl_games are imported here, so that a mistake is reported without them.
    from isaacgymenvs_lite.checkpoints.files import resolve_checkpoint
    from isaacgymenvs_lite.env_factory import make_from_config
    from isaacgymenvs_lite.registration import build_runner, known_names

    tree = config.tree
    num_envs = int(tree["task"]["env"]["numEnvs"])
    small = copy.deepcopy(tree)
    small["task"]["env"]["numEnvs"] = 2
    task = make_from_config(small, sim_device="cpu", rl_device="cpu")
    try:
        states = f", {task.num_states} privileged observations" if task.num_states else ""
        lines = [
            f"task: {task.num_obs} observations{states}, {task.num_actions} actions,"
            f" {task.max_episode_length} control steps of {task.control_dt_s:g} s at most,"
            f" {num_envs:,} environments"
        ]
        params = prepare_train_params(
            tree,
            num_envs=num_envs,
            seed=1,
            num_agents=task.num_agents,
            num_states=task.num_states,
            names=known_names(build_runner()),
        )
        check_env_name(params)
    finally:
        task.close()
    if has_train:
        lines += _train_lines(params)
    if path := checkpoint_in_file(tree):
        lines.append(f"goes on from {resolve_checkpoint(path, 'runs', tree['task']['name'])}")
    if kind == "task":
        unread = keys_without_effect(tree)
    else:
        written = tree["train"]["params"]["config"]
        unread = [f"params.config.{key}" for key in sorted(UNREAD_KEYS) if key in written]
    if unread:
        lines.append(f"{_NO_EFFECT}: {', '.join(unread)}")
    if note := cpu_defaults_note(config.cfg):
        lines.append(note)
    return lines


def _find(file: str) -> Path:
    given = user_path(file)
    if given.is_file():
        return given.resolve()
    named = [cfg_dir() / group / f"{given.stem}.yaml" for group in ("train", "task")]
    for path in named:
        if given.name == file and path.is_file():
            return path
    if published := missing_task(given.stem):
        raise ConfigError(f"{file}: no such file; {published}")
    files = [path for group in ("task", "train") for path in cfg_dir().glob(f"{group}/*.yaml")]
    names = [path.stem for path in files if path.stem not in PARTS]
    raise ConfigError(
        f"{file}: no such file, and no name of a file in {cfg_dir() / 'train'} or"
        f" {cfg_dir() / 'task'}{suggest(given.stem, names)}"
    )


def _refuse_missing_task(path: Path, overrides: Sequence[str]) -> None:
    """Refuse the file of a published task that this project lacks, unless `task=` is given."""
    if any(word.startswith("task=") for word in overrides):
        return
    content = read_yaml(path)
    name = str(content.get("name") or "") if "params" not in content else ""
    missing = missing_task(name) if name else None
    if missing is None and (not name or name == path.stem):
        missing = missing_task(path.stem) or missing_task(_run_name(content))
    if missing:
        raise ConfigError(f"{path.name} is not checked: {missing}")


def _kind(path: Path) -> tuple[str, DictConfig]:
    written = read_yaml(path)
    groups = [group for key, group in _GROUPS.items() if key in written]
    content = compose_file(path, groups[0] if groups else "train")
    if "params" in content:
        return "train", content
    if "env" in content:
        return "task", content
    raise ConfigError(
        f"{path} is neither a train file (a mapping below 'params') nor a task file ('name', 'env',"
        " 'sim')"
    )


def _task_of(path: Path, content: DictConfig) -> str:
    """Return the task of a train file, or the path of the task file.

    The name of the train file and the name of its runs determine the task. MyRobotPPO.yaml, whose
    runs are called MyRobot, belongs neither to a task Robot nor to a task My.
    """
    names = [f.stem for f in (cfg_dir() / "task").glob("*.yaml") if f.stem not in PARTS]
    named, run = task_in_name(path.stem), _run_name(content)
    capital = re.match(r"[A-Z]", named)  # matches MyRobot, but not ASE's name amp_humanoid
    of_its_own = is_foreign(path) and capital and run == named and named not in names
    if not of_its_own and (task := longest_task(path.stem, names)):
        return task
    beside = path.parent.parent / "task" / f"{named}.yaml"
    if beside.is_file():
        return str(beside)
    algorithm = _written(content, "params.algo.name")
    for task, algorithms in _TASKS_OF_ALGORITHMS.items():
        if algorithm in algorithms and not capital:
            return task
    if run in names:
        return run
    raise ConfigError(
        f"{path.name} belongs to none of the tasks here; choose one to check it with, task=<name>:"
        f" {', '.join(sorted(names))}"
    )


def _train_file_of(path: Path, name: str) -> str | None:
    """Return the train file for a task file, or None if no train file exists.

    As for train.py, a file in the folder `train` beside the task file's folder comes first.
    """
    beside = path.parent.parent / "train" / f"{path.stem}PPO.yaml"
    if beside.is_file():
        return str(beside)
    for train in (f"{path.stem}PPO", path.stem, f"{name}PPO"):  # path.stem matches HumanoidSAC.
        if (cfg_dir() / "train" / f"{train}.yaml").is_file():
            return train
    return None


def _run_name(content: DictConfig) -> str:
    """Return the default name of a train file's runs, or '' if the file has no such name."""
    text = str(_written(content, "params.config.name") or "")
    found = _DEFAULT_NAME.match(text)
    return found[1] if found else text


def _written(content: DictConfig, path: str) -> Any:
    return select(OmegaConf.to_container(content, resolve=False), path)


def _train_lines(params: Mapping[str, Any]) -> list[str]:
    config, network = params["config"], params["network"]
    names = f"{params['algo']['name']}, model {params['model']['name']}"
    lines = [f"algorithm: {names}", f"network: {_network_line(network)}"]
    if config.get("central_value_config"):
        critic = config["central_value_config"].get("network", {})
        lines.append(f"asymmetric critic: {_network_line(critic)}")
    envs, epochs = config["num_actors"], config.get("max_epochs", -1)
    steps = config.get("horizon_length") or config.get("num_steps_per_episode", 1)
    samples = envs * steps
    line = f"samples: {envs:,} environments x {steps} steps = {samples:,} in an epoch"
    if "minibatch_size" in config:
        count = samples // config["minibatch_size"]
        line += (
            f"; {config['mini_epochs']} times {count} minibatches of {config['minibatch_size']:,}"
        )
    elif "batch_size" in config:
        line += f"; batches of {config['batch_size']:,} from the replay buffer"
    lines.append(line)
    length = "no limit" if epochs < 0 else f"{epochs:,} epochs, {epochs * samples:,} steps"
    lines.append(f"length: {length}")
    return lines


def _network_line(network: Mapping[str, Any]) -> str:
    parts = [str(network.get("name", ""))]
    mlp = network.get("mlp") or {}
    if mlp:
        units = ", ".join(str(units) for units in mlp.get("units", []))
        parts.append(f"[{units}] {mlp.get('activation', '')}")
    if rnn := network.get("rnn"):
        parts.append(f"{rnn.get('name')} of {rnn.get('units')} units")
    if network.get("separate"):
        parts.append("actor and critic have separate layers")
    return ", ".join(parts)


def keys_without_effect(tree: dict[str, Any]) -> list[str]:
    """Return the keys of a tree's task that only Isaac Gym would read."""
    paths = [f"task.{key}" for key in _UNREAD_TASK_KEYS]
    found = [path for path in paths if select(tree, path) is not None]
    if set(select(tree, "task.sim.physx") or ()) - {"num_threads"}:
        found.append("task.sim.physx.* (except num_threads)")
    return found


def cpu_defaults_note(cfg: DictConfig) -> str | None:
    """Return a line about settings whose defaults differ between CPU and GPU, or None.

    Args:
        cfg: the composed tree; the line exists only if its `rl_device` is a CPU.
    """
    if "cuda" in str(cfg.rl_device):
        return None
    on_gpu = cfg.copy()
    with flag_override(on_gpu, "readonly", False):
        on_gpu.rl_device = _GPU
    here, there = (dict(leaves(plain(tree))) for tree in (cfg, on_gpu))
    changed = []
    for path, value in here.items():
        other = there.get(path)
        if path.startswith(_SECTIONS) and other not in (value, _GPU):
            key = path.removeprefix(next(name for name in _SECTIONS if path.startswith(name)))
            changed.append(f"{key} {_short(value)} ({_short(other)})")
    return f"defaults for learning on a CPU (on a GPU): {', '.join(changed)}" if changed else None


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "-".join(str(entry) for entry in value)
    return "null" if value is None else str(value)


def longest_task(stem: str, tasks: Iterable[str]) -> str | None:
    """Return the longest task name whose words begin a file's name, or None."""
    fitting = [
        name
        for name in tasks
        if stem.startswith(name) and not stem.removeprefix(name)[:1].islower()
    ]
    return max(fitting, key=len, default=None)


def task_in_name(stem: str) -> str:
    """Return a train file's name without the algorithm, MyRobot for MyRobotPPO_LSTM."""
    return _ALGORITHM.sub("", stem).rstrip("_-")


@contextmanager
def _log_lines() -> Iterator[list[str]]:
    """Collect the log messages of the package in a list and do not print them."""
    lines: list[str] = []
    logger = logging.getLogger("isaacgymenvs_lite")
    former = (logger.level, logger.propagate)
    collector = logging.Handler()
    collector.emit = lambda record: lines.append(record.getMessage())
    logger.addHandler(collector)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        yield lines
    finally:
        logger.removeHandler(collector)
        logger.level, logger.propagate = former


if __name__ == "__main__":
    sys.exit(main())
