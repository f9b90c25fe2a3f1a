"""Turns Hydra's and OmegaConf's errors into one line: what was given, the choices, what to do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.config.hydra_bridge import CONFIG_NAME, Loader, parse_overrides
from isaacgymenvs_lite.config.published_names import missing_choice
from isaacgymenvs_lite.errors import ConfigError, one_line, unknown
from isaacgymenvs_lite.paths import PARTS
from isaacgymenvs_lite.schema import leaves, nearest

# What composing a configuration raises for a user's mistake. Hydra raises ValueError for an
# override of a wrong kind, such as a number for a task.
ComposeError = (HydraException, OmegaConfBaseException, ValueError)

_ALIKE = 0.75
# Plugins of Hydra that the extra [sweep] installs.
_PLUGINS = {
    "hydra/sweeper": ("optuna",),
    "hydra/launcher": ("joblib", "submitit_local", "submitit_slurm"),
}


def explain(
    error: Exception, overrides: Sequence[str], loader: Loader, config_name: str = CONFIG_NAME
) -> ConfigError:
    """Return the one-line error for what Hydra or OmegaConf raised while composing.

    Args:
        error: what was raised.
        overrides: the command line's overrides, sweeps included.
        loader: a loader over the same folders; it lists the files that could be named.
        config_name: the root file's name.
    """
    if isinstance(error, ConfigError):
        return error
    if isinstance(error, OverrideParseException):
        return _unreadable_override(error)
    if isinstance(error, MissingConfigException):
        return _missing_file(error, overrides)
    parsed = parse_overrides(overrides)
    for override in parsed:
        group = override.get_key_element()
        is_name = isinstance(override.value(), (str, list)) or override.is_sweep_override()
        if loader.is_group(group) and not is_name and not override.is_delete():
            choices = ", ".join(loader.choices(group))
            return ConfigError(f"'{override.input_line}' names no file; choices: {choices}")
    text = str(error)
    key = _quoted(text)
    if text.startswith("Could not override") and key is not None:
        return _unknown_key(key, overrides, loader, config_name)
    if text.startswith("Ambiguous value") and key is not None:
        return ConfigError(
            f"'{key}' gives several values: add --multirun to run one after the other, "
            "or put them in [ ] to give a list"
        )
    if text.startswith("Could not append") and key is not None:
        return ConfigError(f"the key '{key}' exists: leave out the + before it to change its value")
    if "does not support sweep type" in text:
        return ConfigError(
            "interval(...) has no list of values: add hydra/sweeper=optuna, which chooses them, or"
            " write choice(...) or range(...)"
        )
    reason = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else None
    first = text.split("\n\n")[0]
    return ConfigError(one_line(f"{first} {reason or ''}"))


def explain_interpolation(error: OmegaConfBaseException) -> ConfigError:
    """Return the one-line error for an interpolation that cannot be resolved."""
    where = error.full_key or "the configuration"
    reason = str(error).split("\n")[0]
    if not reason.startswith("Interpolation key"):
        return ConfigError(f"{where}: {reason}")
    return ConfigError(f"{where}: {reason[0].lower()}{reason[1:]}; correct the path in ${{...}}")


def _unreadable_override(error: OverrideParseException) -> ConfigError:
    lines = [line for line in str(error.message).splitlines() if "override" not in line]
    reason = f" ({lines[0].strip()})" if lines else ""
    return ConfigError(
        f"cannot read '{error.override}'{reason}; write key=value, and put a value that holds "
        "blanks or any of = , [ ] { } in quotes: 'key=\"value\"'"
    )


def _missing_file(error: MissingConfigException, overrides: Sequence[str]) -> ConfigError:
    """Explain a task, train or other file that does not exist."""
    path = error.missing_cfg_file or ""
    group, _, name = path.rpartition("/")
    if error.options is None or not group:
        return ConfigError(one_line(str(error).split("\nConfig search path")[0]))
    if name in _PLUGINS.get(group, ()):
        return ConfigError(
            f"{group}={name} needs packages that are not installed;"
            ' pip install "isaacgymenvs-lite[sweep]"'
        )
    options = [option for option in error.options if option not in PARTS]
    if (published := missing_choice(group, name)) is not None:
        return ConfigError(f"{published}; choices: {', '.join(sorted(options))}")
    if group != "train":
        next_step = f"your own files go into cfg/{group} or below a --config-dir"
        return ConfigError(unknown(group, name, options, next_step))
    if any(override.key_or_group == "train" for override in parse_overrides(overrides)):
        return ConfigError(unknown("train file", name, options))
    return ConfigError(
        f"there is no default train file '{name}' for this task: name one with train=; "
        f"choices: {', '.join(sorted(options))}"
    )


def _unknown_key(
    key: str, overrides: Sequence[str], loader: Loader, config_name: str
) -> ConfigError:
    """Explain a key that the tree does not have; list the keys at its level."""
    groups = [
        override.input_line
        for override in parse_overrides(overrides)
        if override.input_line and loader.is_group(override.get_key_element())
    ]
    try:
        composed = loader.compose(groups, config_name, sweeps=True)
    except ComposeError:
        return ConfigError(f"unknown key '{key}'")
    tree: Any = OmegaConf.to_container(composed, resolve=False)
    section, path, leaf = _deepest_section(tree, key)
    if leaf in section:
        parent = f"{path}.{leaf}" if path else leaf
        return ConfigError(f"unknown key '{key}': '{parent}' holds a value, not further keys")
    level = f"the keys of {path}" if path else "the keys"
    choices = sorted(str(name) for name in section if name != "hydra")
    near = nearest(leaf, choices, _ALIKE)
    hint = f" (did you mean '{f'{path}.{near}' if path else near}'?)" if near else ""
    if not hint:
        elsewhere = [other for other in _paths_of_job(tree) if other.rpartition(".")[2] == leaf]
        hint = f" (did you mean '{elsewhere[0]}'?)" if elsewhere else ""
    return ConfigError(
        f"unknown key '{key}'{hint}; {level} are {', '.join(choices)}; +{key}=... adds a new one"
    )


def _deepest_section(tree: dict[Any, Any], key: str) -> tuple[dict[Any, Any], str, str]:
    """Follow the dotted `key` down to the last section that exists.

    Returns:
        That section, its path, and the name that is missing in it.
    """
    section, path = tree, ""
    for name in key.split("."):
        if not isinstance(section.get(name), dict):
            return section, path, name
        section = section[name]
        path = f"{path}.{name}" if path else name
    return section, path, ""


def _paths_of_job(tree: dict[Any, Any]) -> Iterator[str]:
    """Yield the paths of all values that are not Hydra's own."""
    return (path for path, _ in leaves(tree) if path.split(".")[0] != "hydra")


def _quoted(text: str) -> str | None:
    """Return the first part of `text` in single quotes."""
    parts = text.split("'")
    return parts[1] if len(parts) >= 3 else None
