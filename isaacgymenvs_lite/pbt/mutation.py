"""Changes settings at random; the functions have IsaacGymEnvs' names and arguments."""

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
    """Return x times or divided by a random factor, with equal probability."""
    factor = rng.uniform(change_min, change_max)
    return x * factor if rng.random() < 0.5 else x / factor


def mutate_float_min_1(x: float, **options: Any) -> float:
    """Return the result of `mutate_float`, at least 1."""
    return max(1.0, mutate_float(x, **options))


def mutate_eps_clip(x: float, **options: Any) -> float:
    """Return the result of `mutate_float`, limited to PPO's clipping range 0.01 to 0.3."""
    return min(0.3, max(0.01, mutate_float(x, **options)))


def mutate_mini_epochs(x: int, rng: Generator = _GLOBAL, **_: Any) -> int:
    """Return x + 1 or x - 1 with equal probability, limited to 1 to 8."""
    return min(8, max(1, int(x) + (1 if rng.random() < 0.5 else -1)))


def mutate_discount(x: float, rng: Generator = _GLOBAL, **_: Any) -> float:
    """Return a discount whose distance from 1 changed by a factor of 1.1 to 1.2, at least 0."""
    # A small change of gamma changes the learned values a lot.
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
    """Return a function by its name.

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
    """Return settings by path, each changed with the probability `mutation_rate`.

    `mutations` has the name of a function for each path; factors are at least `pbt_change_min` and
    at most `pbt_change_max`.
    """
    options = {"change_min": pbt_change_min, "change_max": pbt_change_max, "rng": rng}
    return {
        path: get_mutation_func(mutations[path])(value, **options)
        if rng.random() < mutation_rate
        else value
        for path, value in params.items()
    }
