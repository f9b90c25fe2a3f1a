"""Makers of the humanoid task, without Hydra: the keys of cfg/task/HumanoidAMP.yaml by hand."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

MakeHumanoid = Callable[..., HumanoidAMP]


@pytest.fixture
def humanoid_cfg(walk_clip: Path) -> Callable[..., dict[str, Any]]:
    """Return `humanoid_cfg(num_envs=4, sim=None, **env)`, a task configuration with changes."""

    def make(num_envs: int = 4, sim: dict[str, Any] | None = None, **env: Any) -> dict[str, Any]:
        return {
            "name": "HumanoidAMP",
            "physics_engine": "physx",
            "env": {"numEnvs": num_envs, "motion_file": str(walk_clip), **env},
            "sim": {
                "dt": 0.0166,
                "substeps": 2,
                "up_axis": "z",
                "gravity": [0.0, 0.0, -9.81],
                "use_gpu_pipeline": False,
                "physx": {"num_threads": 1},
                **(sim or {}),
            },
        }

    return make


@pytest.fixture
def make_humanoid(humanoid_cfg: Callable[..., dict[str, Any]]) -> Iterator[MakeHumanoid]:
    """Return `make_humanoid(num_envs=4, sim=None, cls=HumanoidAMP, **env)`; closes them at the end.

    Keywords are keys of `task.env`.
    """
    made: list[VecTask] = []

    def make(num_envs: int = 4, cls: type[Any] = HumanoidAMP, **changes: Any) -> Any:
        cfg = humanoid_cfg(num_envs, **changes)
        made.append(cls(cfg, "cpu", "cpu", -1, True))
        return made[-1]

    yield make
    for task in made:
        task.close()


@pytest.fixture(autouse=True)
def _hear_warnings(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="isaacgymenvs_lite")
