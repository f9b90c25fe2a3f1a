# pyright: reportMissingImports=false
"""What `VecNormalize` has measured, as arrays in a file.

    env = VecNormalize(Sb3VecEnvWrapper(task))
    load_statistics(env, "logs/sb3/Ant/<date>/model.npz")

`VecNormalize.save` pickles the object, and reading a pickle can run code.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from isaacgymenvs_lite.workflows.checkpoint_files import apply


def save_statistics(normalizer: VecNormalize, file: str | Path) -> None:
    """Write mean, variance and number of observations and of returns, `.npz`."""
    np.savez(Path(file), **_statistics(normalizer))


def load_statistics(normalizer: VecNormalize, file: str | Path) -> None:
    """Take statistics over from a file, without running code of it.

    Raises:
        CheckpointError: they are of other observations, or the file is damaged.
    """

    def take() -> None:
        with np.load(file, allow_pickle=False) as saved:
            for name, own in _statistics(normalizer).items():
                value = saved[name]
                if value.shape != np.shape(own):
                    raise ValueError(f"{name} has shape {value.shape}, not {np.shape(own)}")
                kind, part = name.split("_")
                moments = normalizer.obs_rms if kind == "obs" else normalizer.ret_rms
                setattr(moments, part, value if part != "count" else float(value))

    apply(take, Path(file))


def _statistics(normalizer: VecNormalize) -> dict[str, Any]:
    named = {"obs": normalizer.obs_rms, "ret": normalizer.ret_rms}
    return {
        f"{name}_{part}": getattr(moments, part)
        for name, moments in named.items()
        if normalizer.norm_obs or name == "ret"
        for part in ("mean", "var", "count")
    }
