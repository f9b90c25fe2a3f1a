"""The names of IsaacGymEnvs' `pbt.pbt`, for train scripts that make a Runner themselves."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.config.launch import resolve_seed
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.pbt.observer import PBTObserver, first_mutation, population_of
from isaacgymenvs_lite.pbt.restart import RestartRequest, start_again
from isaacgymenvs_lite.schema import plain


def initial_pbt_check(cfg: DictConfig) -> None:
    """Change the settings of a composed tree by the policy's initial mutation, in place."""
    for path, value in first_mutation(plain(cfg), _seed(cfg)).items():
        OmegaConf.update(cfg, path, value)


class PbtAlgoObserver(AlgoObserver):
    """Compares the policy with its population; restarts the script if the policy is replaced."""

    def __init__(self, cfg: DictConfig) -> None:
        super().__init__()
        self._cfg = cfg
        self._open = ExitStack()

    def after_init(self, algo: Any) -> None:
        """Join the population."""
        self._algo = algo
        population = population_of(plain(self._cfg), _seed(self._cfg), Path(algo.train_dir))
        observer = self._open.enter_context(population)
        if observer is None:
            raise ConfigError("pbt.enabled=False: PbtAlgoObserver needs pbt=pbt_default")
        self._observer: PBTObserver = observer
        observer.after_init(algo)

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Store the objectives of the environments `done_indices` (n, 1), whose episodes ended."""
        self._observer.process_infos(infos, done_indices)

    def after_steps(self) -> None:
        """Compare the policy after each interval, and restart the script if it is replaced."""
        try:
            self._observer.after_steps()
        except RestartRequest as request:
            self._algo.writer.flush()
            self._algo.writer.close()
            self._open.close()
            if (wandb := sys.modules.get("wandb")) is not None and wandb.run is not None:
                wandb.run.finish()
            start_again(request, sys.argv[1:])


def _seed(cfg: DictConfig) -> int:
    return resolve_seed(int(cfg.seed), bool(cfg.get("torch_deterministic", False)))
