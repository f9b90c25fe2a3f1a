"""Composes the configuration tree from a list of overrides, without a command line."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import MappingProxyType

from omegaconf import DictConfig, open_dict

from isaacgymenvs_lite.config.foreign_files import check_composed_tree, is_foreign
from isaacgymenvs_lite.config.hydra_bridge import (
    Loader,
    NamedFiles,
    Rules,
    loader_of_folders,
    program_composes_by,
)
from isaacgymenvs_lite.config.hydra_errors import ComposeError, explain
from isaacgymenvs_lite.config.path_overrides import FileReader, PathOverrides
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir

ANY_TRAIN_FILE = "CartpolePPO"
"""The train file of trees of which only the task is read."""


def compose(overrides: Sequence[str] = (), config_dir: Path | str | None = None) -> DictConfig:
    """Compose the configuration tree as `python train.py <overrides>` does.

    Hydra's global state is as before afterwards, so this may be called inside a running Hydra job;
    the job's task and train file have no influence on the result.

    Args:
        overrides: as on the command line, for example `["task=HumanoidAMP", "num_envs=64"]`;
            `train=` and `task=` may name files by their paths.
        config_dir: a folder with further task/ and train/ files, as `--config-dir`.

    Returns:
        The tree with the keys of cfg/config.yaml, interpolations unresolved, in struct mode.

    Raises:
        ConfigError: a name, a key or an override is wrong; the message lists the choices.
    """
    register_resolvers()
    named = PathOverrides.from_words(overrides)
    loader = make_loader(config_dir, files=named.files)
    try:
        cfg = loader.compose(named.words)
    except ComposeError as error:
        raise explain(error, named.words, loader) from error
    with open_dict(cfg):
        del cfg["hydra"]
    return cfg


def compose_task(
    task: str, overrides: Sequence[str] = (), config_dir: Path | str | None = None
) -> DictConfig:
    """Compose the tree of a task that a program or another library makes; see `compose`.

    Not every task has a train file. The tree gets PPO's, which nothing reads.

    Args:
        task: name of a task file.
        overrides: further words; `task=` and `train=` among them count instead.
        config_dir: as `compose`.
    """
    words = [
        f"{group}={name}"
        for group, name in (("task", task), ("train", ANY_TRAIN_FILE))
        if not any(word.startswith(f"{group}=") for word in overrides)
    ]
    return compose([*words, *overrides], config_dir)


def make_loader(
    config_dir: Path | str | None = None,
    config_path: Path | str | None = None,
    files: NamedFiles = MappingProxyType({}),
) -> Loader:
    """Return a loader over our cfg/ (or `config_path`), then `config_dir` if given.

    Args:
        config_dir: a folder with further task/ and train/ files.
        config_path: a folder in place of cfg/.
        files: see `PathOverrides`.

    Raises:
        ConfigError: `config_dir` is no folder.
    """
    folder = None
    if config_dir is not None:
        folder = Path(config_dir).resolve()
        if not folder.is_dir():
            raise ConfigError(
                f"the configuration folder '{config_dir}' does not exist; "
                "expected a folder that holds task/ and train/"
            )
    return loader_of_folders(_rules(), files, config_path or cfg_dir(), first=folder)


def checked_program(files: NamedFiles) -> AbstractContextManager[None]:
    """Return a context in which Hydra's program, `hydra.main`, composes as `compose` does."""
    return program_composes_by(_rules(), files)


def _rules() -> Rules:
    return Rules(FileReader(), is_foreign, check_composed_tree)
