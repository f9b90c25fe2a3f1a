"""Composes the configuration tree from a list of overrides, without a command line."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.staging import GROUPS, REFUSED, ROOT, StagedFiles, staged
from isaacgymenvs_lite.errors import ConfigError, one_line, unknown
from isaacgymenvs_lite.paths import PARTS
from isaacgymenvs_lite.schema import leaves, nearest

ANY_TRAIN_FILE = "CartpolePPO"
"""The train file of trees that are composed only for their task section."""
# Hydra's `version_base`. IsaacGymEnvs has 1.1, which warns at every start. cfg/config.yaml sets
# both values in which the versions differ: the working directory, and `_self_` in the defaults
# list.
HYDRA_VERSION_BASE = "1.3"

# Hydra and OmegaConf raise these errors for a user's mistake. Hydra raises ValueError for an
# override of a wrong type, for example a number for a task.
ComposeError = (HydraException, OmegaConfBaseException, ValueError, RecursionError)

_ALIKE = 0.75
# Maps the beginning of a published task's name to a description.
_PUBLISHED_TASKS = {
    "AllegroHandDextreme": "DeXtreme's hand that turns an object",
    "AllegroKuka": "a Kuka arm with an Allegro hand",
    "AutoMate": "assembly with a Franka arm",
    "Factory": "assembly with a Franka arm",
    "HumanoidAMPGetup": "ASE's humanoid that gets up, here HumanoidASEGetup",
    "IndustReal": "assembly with a Franka arm",
    "TacSL": "assembly with a Franka arm",
}
_PLUGINS = ("optuna", "joblib", "submitit_local", "submitit_slurm")


def compose(
    overrides: Sequence[str] = (), config_dir: Path | str | None = None, *, trains: bool = True
) -> DictConfig:
    """Compose the configuration tree as `python train.py <overrides>` does.

    A running Hydra job may call this function; the task and train file of the job have no
    influence.

    Args:
        overrides: settings, for example `["task=HumanoidAMP", "num_envs=64"]`; `train=` and
            `task=` may name files by their paths.
        config_dir: a folder with more task/ and train/ files, like `--config-dir`.
        trains: whether the result may be used for a training, which writes into the folder that the
            files name.

    Returns:
        The tree with the keys of cfg/config.yaml, interpolations unresolved, in struct mode.

    Raises:
        ConfigError: a name, a key or an override is wrong; the message lists the choices.
    """
    with staged(overrides, config_dir, trains=trains) as files:
        try:
            return _compose_in(files.folder, files.words)
        except ComposeError as error:
            raise explain(error, files) from error


def compose_task(
    task: str, overrides: Sequence[str] = (), config_dir: Path | str | None = None
) -> DictConfig:
    """Compose the tree of a task for a program or another library; see `compose`.

    The tree contains an arbitrary train file, because a task may have no train file; nobody reads
    its content. `task=` and `train=` among the overrides take precedence.
    """
    words = [
        f"{group}={name}"
        for group, name in (("task", task), ("train", ANY_TRAIN_FILE))
        if not any(word.startswith(f"{group}=") for word in overrides)
    ]
    return compose([*words, *overrides], config_dir)


def changed_by(tree: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Apply overrides to a copy of a stored tree, for example a run's config.yaml, and return it.

    Raises:
        ConfigError: an override is wrong, or its key is not in the tree.
    """
    with tempfile.TemporaryDirectory() as folder:
        OmegaConf.save(tree, Path(folder) / f"{ROOT}.yaml")
        try:
            return _compose_in(Path(folder), overrides)
        except ComposeError as error:
            raise explain(error, StagedFiles(list(overrides), Path(folder))) from error


def _compose_in(folder: Path, words: Sequence[str]) -> DictConfig:
    """Let Hydra compose the files of a folder; restore the state of a running Hydra program."""
    register_resolvers()
    running, base = GlobalHydra.instance(), VersionBase.instance().version_base
    program, running.hydra = running.hydra, None
    try:
        with hydra.initialize_config_dir(str(folder), version_base=HYDRA_VERSION_BASE):
            return hydra.compose(ROOT, overrides=list(words))
    finally:
        GlobalHydra.set_instance(running)
        running.hydra = program
        VersionBase.instance().version_base = base


# --- errors ---------------------------------------------------------------------------------------


def explain(error: Exception, files: StagedFiles) -> ConfigError:
    """Return a one-line error for an error that Hydra or OmegaConf raised while composing."""
    words = files.words
    text = str(error)
    key = text.split("'")[1] if text.count("'") > 1 else ""
    if isinstance(error, ConfigError):
        return error
    if isinstance(error, RecursionError):
        return ConfigError(
            "the defaults lists of the configuration files run in a circle; remove the file's own"
            " name from its list, or rename the file if cfg/ has a file of the same name"
        )
    if isinstance(error, OverrideParseException):
        return ConfigError(
            f"cannot read '{error.override}'; write key=value, and put a value with blanks or any"
            " of = , [ ] { } in quotes: 'key=\"value\"'"
        )
    if isinstance(error, MissingConfigException):
        refused = (error.missing_cfg_file or "").removeprefix(f"{REFUSED}/")
        return files.refused.get(refused) or _missing_file(error, words)
    if text.startswith("Could not override"):
        return _unknown_key(key, files)
    if text.startswith("Ambiguous value"):
        return ConfigError(
            f"'{key}' gives several values: add --multirun to run one after the other, "
            "or put them in [ ] to give a list"
        )
    if text.startswith("Could not append"):
        return ConfigError(f"the key '{key}' exists: leave out the + before it to change its value")
    if "does not support sweep type" in text:
        return ConfigError(
            "interval(...) has no list of values: add hydra/sweeper=optuna, which chooses them, or"
            " write choice(...) or range(...)"
        )
    if text.startswith("Config group override must be a string"):
        given = next(word for word in words if word.partition("=")[0] in GROUPS)
        return ConfigError(f"'{given}' names no file; expected a name, or the path of a file")
    reason = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else ""
    first = text.split("\n\n")[0]
    return ConfigError(one_line(f"{first} {reason}"))


def explain_interpolation(error: OmegaConfBaseException) -> ConfigError:
    """Return the one-line error for an interpolation that cannot be resolved."""
    reason = str(error).split("\n")[0]
    hint = "; correct the path in ${...}" if reason.startswith("Interpolation key") else ""
    return ConfigError(f"{error.full_key or 'the configuration'}: {reason}{hint}")


def _missing_file(error: MissingConfigException, words: Sequence[str]) -> ConfigError:
    """Return the error for a configuration file that does not exist."""
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    if error.options is None or not group:
        return ConfigError(one_line(str(error).split("\nConfig search path")[0]))
    if name in _PLUGINS:
        return ConfigError(
            f"{group}={name} needs packages that are not installed;"
            ' pip install "isaacgymenvs-lite[sweep]"'
        )
    options = sorted(option for option in error.options if option not in PARTS)
    if group in ("task", "train") and (published := missing_task(name)):
        return ConfigError(f"{published}; choices: {', '.join(options)}")
    if group != "train":
        next_step = f"your own files go into cfg/{group} or below a --config-dir"
        return ConfigError(unknown(group, name, options, next_step))
    if any(word.lstrip("+").startswith("train=") for word in words):
        return ConfigError(unknown("train file", name, options))
    return ConfigError(
        f"there is no default train file '{name}' for this task: name one with train=; "
        f"choices: {', '.join(options)}"
    )


def _unknown_key(key: str, files: StagedFiles) -> ConfigError:
    """Return the error for a key that the tree lacks; the error lists the keys beside it."""
    groups = [word for word in files.words if word.partition("=")[0].split("/")[0] in GROUPS]
    try:
        tree: Any = OmegaConf.to_container(_compose_in(files.folder, groups), resolve=False)
    except ComposeError:
        return ConfigError(f"unknown key '{key}'")
    section, path, leaf = tree, "", key
    while isinstance(section.get(leaf.split(".")[0]), dict):
        name, _, leaf = leaf.partition(".")
        section, path = section[name], f"{path}.{name}" if path else name
    leaf = leaf.split(".")[0]
    if leaf in section:
        parent = f"{path}.{leaf}" if path else leaf
        return ConfigError(f"unknown key '{key}': '{parent}' holds a value, not keys of its own")
    choices = sorted(str(name) for name in section)
    near = nearest(leaf, choices, _ALIKE)
    meant = [f"{path}.{near}" if path else near] if near else []
    meant = meant or [other for other, _ in leaves(tree) if other.rpartition(".")[2] == leaf]
    hint = f" (did you mean '{meant[0]}'?)" if meant else ""
    level = f"the keys of {path}" if path else "the keys"
    return ConfigError(
        f"unknown key '{key}'{hint}; {level} are {', '.join(choices)}; +{key}=... adds a new one"
    )


def missing_task(name: str) -> str | None:
    """Return a message if `name` is a published task that this project lacks, else None.

    The name may also be a train file's name, for example `AllegroKukaPPO`.
    """
    family = next((known for known in _PUBLISHED_TASKS if name.startswith(known)), None)
    if family is None:
        return None
    task = re.sub(r"(?:PPO|SAC)\w*$", "", name)
    return f"{task} is a published task ({_PUBLISHED_TASKS[family]}) that is not here"
