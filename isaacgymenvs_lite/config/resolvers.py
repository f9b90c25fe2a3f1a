"""Registers the interpolation functions of IsaacGymEnvs' YAML files.

- `${eq:a,b}`: a equals b, ignoring case; both are text
- `${contains:a,b}`: a is part of b, ignoring case
- `${if:p,a,b}`: a if p is true in Python's sense, else b; the text "False" is true
- `${resolve_default:d,x}`: d if x is '', else x
- `${default_rl_device:}`: cuda:0 if torch sees a GPU, else cpu; this project's own
- `${default_seed:}`: the train file's own seed, else 42; this project's own
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.hydra_bridge import allow_registering_again, parse_interpolations

_DEFAULT_SEED = 42  # as IsaacGymEnvs


def equal(a: str, b: str) -> bool:
    """Compare two texts, ignoring case."""
    return a.lower() == b.lower()


def contains(part: str, whole: str) -> bool:
    """Return whether `part` occurs in `whole`, ignoring case."""
    return part.lower() in whole.lower()


def choose(predicate: Any, if_true: Any, if_false: Any) -> Any:
    """Return `if_true` for a true `predicate`: '' is false, any other text is true."""
    chosen = if_true if predicate else if_false
    # OmegaConf.resolve (`--cfg job --resolve`) takes no plain list back.
    return OmegaConf.create(chosen) if isinstance(chosen, list | dict) else chosen


def resolve_default(default: Any, given: Any) -> Any:
    """Return `given` unless it is the empty text; None, 0 and False count as given."""
    return default if isinstance(given, str) and given == "" else given


def default_rl_device() -> str:
    """Return "cuda:0" if torch sees a GPU, else "cpu"."""
    import torch  # here, because it takes a second that a misspelt key should not cost

    return "cuda:0" if torch.cuda.is_available() else "cpu"


def default_seed(*, _root_: DictConfig) -> Any:
    """Return the train file's seed if it is a plain value, not an interpolation, else 42."""
    params = OmegaConf.select(_root_, "train.params")
    if not isinstance(params, DictConfig) or OmegaConf.is_interpolation(params, "seed"):
        return _DEFAULT_SEED
    seed = params.get("seed")
    return _DEFAULT_SEED if seed is None else seed


RESOLVERS: dict[str, Callable[..., Any]] = {
    "eq": equal,
    "contains": contains,
    "if": choose,
    "resolve_default": resolve_default,
    "default_rl_device": default_rl_device,
    "default_seed": default_seed,
}
"""By name. None of them looks outside of the configuration: any file may use them."""


def register_resolvers() -> None:
    """Make the functions known to OmegaConf, also if another package has registered the names."""
    for name, function in RESOLVERS.items():
        OmegaConf.register_new_resolver(name, function, replace=True)


def without_environment(cfg: DictConfig) -> DictConfig:
    """Return a tree that any machine can read: `${oc.env:X}` and the like become their values.

    A file that is read may use no other functions than those of this module, which do not look
    outside of it. A command line may; what it means is decided where it is typed.

    Args:
        cfg: the tree; its other interpolations stay.
    """
    copied = cfg.copy()
    for path, text in _texts(OmegaConf.to_container(cfg, resolve=False), ()):
        if "${" in text and set(parse_interpolations(text).resolvers) - set(RESOLVERS):
            key = ".".join(path)
            OmegaConf.update(copied, key, OmegaConf.select(cfg, key))
    return copied


def _texts(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the path and the content of each text in nested dictionaries and lists."""
    if isinstance(value, str):
        yield path, value
    entries: Iterable[tuple[Any, Any]] = ()
    if isinstance(value, dict):
        entries = value.items()
    elif isinstance(value, list):
        entries = enumerate(value)
    for key, entry in entries:
        yield from _texts(entry, (*path, str(key)))


def let_scripts_register() -> None:
    """Let a script register our names once more, as IsaacGymEnvs' first train.py does."""
    allow_registering_again(RESOLVERS)
