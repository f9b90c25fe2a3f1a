"""The tasks, by the name that `task.name` in a task file gives."""

from __future__ import annotations

from collections.abc import Callable

from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.ant import Ant
from isaacgymenvs_lite.tasks.ase.humanoid_ase import (
    HumanoidASE,
    HumanoidHeading,
    HumanoidLocation,
    HumanoidReach,
    HumanoidStrike,
)
from isaacgymenvs_lite.tasks.ase.humanoid_ase_getup import HumanoidASEGetup
from isaacgymenvs_lite.tasks.ase.humanoid_perturb import HumanoidPerturb
from isaacgymenvs_lite.tasks.ase.humanoid_view_motion import HumanoidViewMotion
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.tasks.cartpole import Cartpole

isaacgym_task_map: dict[str, Callable[..., VecTask]] = {
    "Ant": Ant,
    "Cartpole": Cartpole,
    "HumanoidAMP": HumanoidAMP,
    "HumanoidASE": HumanoidASE,
    "HumanoidASEGetup": HumanoidASEGetup,
    "HumanoidHeading": HumanoidHeading,
    "HumanoidLocation": HumanoidLocation,
    "HumanoidPerturb": HumanoidPerturb,
    "HumanoidReach": HumanoidReach,
    "HumanoidStrike": HumanoidStrike,
    "HumanoidViewMotion": HumanoidViewMotion,
}
