"""Changes settings at random, by functions with IsaacGymEnvs' names and arguments."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from typing import Any

from isaacgymenvs_lite.config.pbt_settings import MUTATIONS
from isaacgymenvs_lite.errors import ConfigError, unknown

CHANGE_MIN, CHANGE_MAX = 1.1, 1.5

Generator = random.Random
_GLOBAL = random.Random()


def mutate_float(
    x: float,
    change_min: float = CHANGE_MIN,
    change_max: float = CHANGE_MAX,
    rng: Generator = _GLOBAL,
) -> float:
    """Multiply or divide x by a random factor, each with probability 1/2; return the result."""
    factor = rng.uniform(change_min, change_max)
    return x * factor if rng.random() < 0.5 else x / factor


def mutate_float_min_1(x: float, **options: Any) -> float:
    """Return the maximum of 1 and the result of `mutate_float`."""
    return max(1.0, mutate_float(x, **options))


def mutate_eps_clip(x: float, **options: Any) -> float:
    """Return the result of `mutate_float`, clipped to [0.01, 0.3], for PPO's `e_clip`."""
    return min(0.3, max(0.01, mutate_float(x, **options)))


def mutate_mini_epochs(x: int, rng: Generator = _GLOBAL, **_: Any) -> int:
    """Return x + 1 or x - 1 with equal probability, clipped to the range from 1 to 8."""
    return min(8, max(1, int(x) + (1 if rng.random() < 0.5 else -1)))


def mutate_discount(x: float, rng: Generator = _GLOBAL, **_: Any) -> float:
    """Multiply or divide 1 - x by a factor of 1.1 to 1.2; return 1 minus the result, or 0."""
    # The factor is small, because small changes of the discount change learned values a lot.
    return max(0.0, 1.0 - mutate_float(1.0 - x, 1.1, 1.2, rng=rng))


_FUNCTIONS: dict[str, Callable[..., float]] = {
    function.__name__: function
    for function in (
        mutate_float,
        mutate_float_min_1,
        mutate_eps_clip,
        mutate_mini_epochs,
        mutate_discount,
    )
}


def get_mutation_func(mutation_func_name: str) -> Callable[..., float]:
    """Return the function with a name.

    Raises:
        ConfigError: the name is unknown.
    """
    if mutation_func_name not in _FUNCTIONS:
        raise ConfigError(unknown("function", mutation_func_name, MUTATIONS))
    return _FUNCTIONS[mutation_func_name]


def mutate(
    params: Mapping[str, float],
    mutations: Mapping[str, str],
    mutation_rate: float,
    pbt_change_min: float,
    pbt_change_max: float,
    rng: Generator = _GLOBAL,
) -> dict[str, float]:
    """Change each setting with the probability `mutation_rate`; return all settings.

    `mutations` maps the path of each setting to the name of a function. Random factors are between
    `pbt_change_min` and `pbt_change_max`.
    """
    options = {"change_min": pbt_change_min, "change_max": pbt_change_max, "rng": rng}
    return {
        path: get_mutation_func(mutations[path])(value, **options)
        if rng.random() < mutation_rate
        else value
        for path, value in params.items()
    }
