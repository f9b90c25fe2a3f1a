"""Registers the interpolation functions of IsaacGymEnvs' YAML files.

- `${eq:a,b}`: whether the texts a and b are equal, ignoring case
- `${contains:a,b}`: whether a is part of b, ignoring case
- `${if:p,a,b}`: a if Python regards p as true, else b; the text "False" counts as true
- `${resolve_default:d,x}`: d if x is '', else x
- `${default_rl_device:}`: cuda:0 if torch sees a GPU, else cpu (not in IsaacGymEnvs)
- `${default_seed:}`: the seed in the train file, or 42 without it (not in IsaacGymEnvs)
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from omegaconf import DictConfig, OmegaConf

_DEFAULT_SEED = 42  # as in IsaacGymEnvs
# Matches a $ with the path or the function's name that follows it.
_INTERPOLATION = re.compile(r"\$(?:\{\s*([\w.\[\]-]*)\s*([:}]))?")


def choose(predicate: Any, if_true: Any, if_false: Any) -> Any:
    """Return `if_true` if `predicate` is true, else `if_false`; every text but '' is true."""
    chosen = if_true if predicate else if_false
    # OmegaConf.resolve (`--cfg job --resolve`) refuses plain lists as results.
    return OmegaConf.create(chosen) if isinstance(chosen, list | dict) else chosen


def resolve_default(default: Any, given: Any) -> Any:
    """Return `given` unless it is the empty text; None, 0 and False count as given."""
    return default if isinstance(given, str) and given == "" else given


def default_rl_device() -> str:
    """Return "cuda:0" if torch sees a GPU, else "cpu"."""
    import torch  # takes a second, which a misspelt key need not cost

    return "cuda:0" if torch.cuda.is_available() else "cpu"


def default_seed(*, _root_: DictConfig) -> Any:
    """Return the seed in the train file, or 42 if the seed is missing or an interpolation."""
    params = OmegaConf.select(_root_, "train.params")
    if not isinstance(params, DictConfig) or OmegaConf.is_interpolation(params, "seed"):
        return _DEFAULT_SEED
    seed = params.get("seed")
    return _DEFAULT_SEED if seed is None else seed


RESOLVERS: dict[str, Callable[..., Any]] = {
    "eq": lambda a, b: a.lower() == b.lower(),
    "contains": lambda part, whole: part.lower() in whole.lower(),
    "if": choose,
    "resolve_default": resolve_default,
    "default_rl_device": default_rl_device,
    "default_seed": default_seed,
}
"""Maps names to functions that read only the configuration, so that any file may use them."""


def register_resolvers() -> None:
    """Register the functions with OmegaConf; they replace functions of the same names."""
    for name, function in RESOLVERS.items():
        OmegaConf.register_new_resolver(name, function, replace=True)


def register_for(script: str) -> None:
    """Register these functions as resolvers, except those that the code `script` registers itself.

    OmegaConf refuses the second registration of a name.
    """
    register_resolvers()
    for name in RESOLVERS:
        if re.search(rf"register_new_resolver\(\s*['\"]{name}['\"]", script):
            OmegaConf.clear_resolver(name)


def forbidden_resolver(text: str) -> str | None:
    """Return the first interpolation in a text that is refused in foreign files, or None.

    A resolver of another package is refused because it may run code or read the environment. A
    nested interpolation and a single $ are also refused, because resolving the text could turn them
    into calls of resolvers.
    """
    for found in _INTERPOLATION.finditer(text):
        path, end = found.groups()
        if end is None or (end == ":" and path not in RESOLVERS):
            return path or "$"
    return None
