"""From a list of overrides to the composed configuration tree, without a command line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.utils import setup_globals
from hydra.types import RunMode
from omegaconf import DictConfig, open_dict

from isaacgymenvs_lite.config.hydra_bridge import CONFIG_NAME, CheckedLoader
from isaacgymenvs_lite.config.hydra_errors import ComposeError, explain
from isaacgymenvs_lite.config.path_overrides import outside_files
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.yaml_files import tolerant_hydra
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir

# 1.3, not 1.1 as IsaacGymEnvs asked for: the two differ in what cfg/config.yaml states anyway (stay
# in the working directory, `_self_` in the defaults list), and 1.1 warns at every start.
HYDRA_VERSION_BASE = "1.3"

ANY_TRAIN_FILE = "CartpolePPO"
"""What stands for the train file of a tree of which only the task is read."""


def compose(overrides: Sequence[str] = (), config_dir: Path | str | None = None) -> DictConfig:
    """Compose the configuration tree as `python train.py <overrides>` does.

    It leaves Hydra's global state alone, so it may be called inside a running Hydra job, whose own
    choices of task and train file have no influence on the result.

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
    setup_globals()
    with tolerant_hydra(), _version_base(), outside_files(overrides) as named:
        loader = make_loader(config_dir)
        try:
            cfg = loader.load_configuration(CONFIG_NAME, named, RunMode.RUN, from_shell=False)
        except ComposeError as error:
            raise explain(error, named, loader, CONFIG_NAME) from error
    with open_dict(cfg):
        del cfg["hydra"]
    return cfg


def compose_task(
    task: str, overrides: Sequence[str] = (), config_dir: Path | str | None = None
) -> DictConfig:
    """Compose the tree of a task that another library's agent trains on; see `compose`.

    A tree has a train file, and not every task one of its own: one is taken that there always is,
    and nothing of it is read.

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
    config_dir: Path | str | None = None, config_path: Path | str | None = None
) -> ConfigLoaderImpl:
    """Return Hydra's loader over our cfg/ (or `config_path`), then `config_dir` if given.

    Raises:
        ConfigError: `config_dir` is no folder.
    """
    search_path = create_config_search_path(str(config_path or cfg_dir()))
    if config_dir is not None:
        folder = Path(config_dir).resolve()
        if not folder.is_dir():
            raise ConfigError(
                f"the configuration folder '{config_dir}' does not exist; "
                "expected a folder that holds task/ and train/"
            )
        search_path.prepend(
            provider="config_dir", path=f"file://{folder}", anchor=SearchPathQuery("schema", None)
        )
    return CheckedLoader(config_search_path=search_path)


@contextmanager
def _version_base() -> Iterator[None]:
    """Compose by the rules of our Hydra version, whatever the surrounding program has chosen."""
    holder = version.VersionBase.instance()
    former = holder.version_base
    version.setbase(HYDRA_VERSION_BASE)
    try:
        yield
    finally:
        holder.version_base = former
