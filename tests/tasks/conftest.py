"""Makers of the humanoids' tasks, without Hydra: the keys of cfg/task by hand."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import HumanoidAMPBase
from isaacgymenvs_lite.tasks.ase.humanoid_ase import HumanoidASE
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from tests.tiny import composed

MakeHumanoid = Callable[..., HumanoidAMP]
MakeASE = Callable[..., HumanoidASE]

# Key bodies of ASE's files for the humanoid with sword and shield.
_ARMED_KEY_BODIES = ["right_hand", "left_hand", "right_foot", "left_foot", "sword", "shield"]


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


@pytest.fixture
def make_ase(make_humanoid: MakeHumanoid, armed_walk_clip: Path) -> MakeASE:
    """Return `make_ase(num_envs=4, cls=HumanoidASE, armed=False, sim=None, **env)`."""

    def make(
        num_envs: int = 4,
        cls: type[HumanoidASE] = HumanoidASE,
        armed: bool = False,
        sim: dict[str, Any] | None = None,
        **env: Any,
    ) -> Any:
        if armed:
            env = {
                "asset": {"assetFileName": "mjcf/amp_humanoid_sword_shield.xml"},
                "keyBodies": _ARMED_KEY_BODIES,
                "motion_file": str(armed_walk_clip),
                **env,
            }
        return make_humanoid(num_envs, cls=cls, sim={"dt": 1.0 / 60.0, **(sim or {})}, **env)

    return make


@pytest.fixture
def make_task() -> Iterator[Callable[..., Any]]:
    """Return `make_task(*overrides, num_envs=4)`, a maker by the command line's overrides."""
    made: list[VecTask] = []

    def make(*overrides: str, num_envs: int = 4) -> Any:
        cfg = composed([f"num_envs={num_envs}", "num_threads=1", *overrides])
        made.append(make_from_config(cfg, sim_device="cpu", rl_device="cpu"))
        return made[-1]

    yield make
    for task in made:
        task.close()


@pytest.fixture
def controls_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[VecTask], list[Tensor]]:
    """Return `controls_of(task)`, a list that the controls are added to that the task sets."""

    def note(task: VecTask) -> list[Tensor]:
        seen: list[Tensor] = []
        set_controls = task.simulation.set_controls

        def noting(controls: Tensor) -> None:
            seen.append(controls.clone())
            set_controls(controls)

        monkeypatch.setattr(task.simulation, "set_controls", noting)
        return seen

    return note


@pytest.fixture
def hold_pose() -> Callable[[HumanoidAMPBase], Tensor]:
    """Return `hold_pose(task)`, actions (N, D) whose PD targets are the joints' positions of now.

    Within +-1, so that joints may stay away from targets that no action reaches.
    """

    def actions(task: HumanoidAMPBase) -> Tensor:
        _, offset, scale = task.action_scaling()
        wanted = (task.simulation.dof_pos - offset) / scale
        return wanted.clamp(-1.0, 1.0)

    return actions


@pytest.fixture(autouse=True)
def _hear_warnings(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="isaacgymenvs_lite")
