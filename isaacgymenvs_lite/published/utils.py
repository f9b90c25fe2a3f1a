"""The names of IsaacGymEnvs' `utils.utils`."""

from __future__ import annotations

import numpy as np

from isaacgymenvs_lite.config.seeds import resolve_seed
from isaacgymenvs_lite.making import seed_everything

__all__ = ["set_np_formatting", "set_seed"]


def set_np_formatting() -> None:
    """Let numpy print whole rows with two digits."""
    np.set_printoptions(edgeitems=30, linewidth=4000, precision=2, threshold=10000)


def set_seed(seed: int, torch_deterministic: bool = False, rank: int = 0) -> int:
    """Seed Python, numpy and torch, another one in each process; return the seed.

    Args:
        seed: -1 draws one.
        torch_deterministic: forbid nondeterministic kernels.
        rank: of this process.
    """
    resolved = resolve_seed(seed, torch_deterministic, rank)
    seed_everything(resolved, torch_deterministic)
    return resolved
