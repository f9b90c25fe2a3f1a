"""Which seed a run gets."""

from __future__ import annotations

import secrets

_SEED_OF_DETERMINISTIC_RUNS = 42
_RANDOM_SEEDS = 10_000


def resolve_seed(seed: int, torch_deterministic: bool = False, rank: int = 0) -> int:
    """Return the seed of the process `rank`.

    A `seed` of -1 asks for any: 42 + rank in a deterministic run, else one drawn from [0, 10000),
    independently of the state of all generators. Any other seed is shifted by the rank.
    """
    if seed != -1:
        return seed + rank
    if torch_deterministic:
        return _SEED_OF_DETERMINISTIC_RUNS + rank
    return secrets.randbelow(_RANDOM_SEEDS)
