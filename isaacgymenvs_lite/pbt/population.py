"""Decides which policy of a population is replaced, and by which one.

The rules follow DexPBT (Petrenko et al. 2023, arXiv:2305.12127) as IsaacGymEnvs has them.
"""

from __future__ import annotations

import math
import random
import statistics
from collections.abc import Mapping

from isaacgymenvs_lite.config.pbt_settings import PBTSettings

# Share of the population, the worst, that the spread is measured without: a policy that broke down
# would hide all other differences.
_OUTLIERS = 0.2


def find_replacement(
    settings: PBTSettings,
    objectives: Mapping[int, float],
    best_of_interval: float,
    rng: random.Random,
) -> int | None:
    """Return the policy whose weights the own one goes on with; None if it goes on unchanged.

    A policy among the worst goes on with new settings in any case. It gets the weights of one of
    the best only if the difference is clear; else the result is its own index.

    Args:
        settings: of the population.
        objectives: of the policies that are known, the own one among them, by index.
        best_of_interval: best objective of the own policy since the last comparison.
        rng: chooses among the best.
    """
    own, total = settings.policy_idx, settings.num_policies
    ranked = sorted(objectives, key=lambda index: (-objectives[index], index))
    best = ranked[: math.ceil(settings.replace_fraction_best * total)]
    if not settings.dbg_mode:
        # A policy that is not known yet ranks behind all others.
        unknown = [index for index in range(total) if index not in objectives]
        worst = [*ranked, *unknown][-math.ceil(settings.replace_fraction_worst * total) :]
        reached = min(objectives[index] for index in best)
        if (
            own not in worst
            or best_of_interval >= reached
            or len(objectives) < num_needed(settings.num_policies)
        ):
            return None
    donor = rng.choice(best)
    lead = objectives[donor] - objectives[own]
    by_spread = settings.replace_threshold_frac_std * _spread(objectives)
    by_size = settings.replace_threshold_frac_absolute * abs(objectives[donor])
    return donor if lead > by_spread and lead > by_size else own


def num_needed(num_policies: int) -> int:
    """Return how many policies must be known before one is replaced: more than half of them.

    At least three, as in IsaacGymEnvs; there a population of two never changes, here two do.
    """
    return min(num_policies, max(2, num_policies // 2) + 1)


def _spread(objectives: Mapping[int, float]) -> float:
    """Return the standard deviation of a population, without its outliers below."""
    values = sorted(objectives.values())
    return statistics.pstdev(values[math.floor(_OUTLIERS * len(values)) :])
