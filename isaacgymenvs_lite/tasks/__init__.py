"""The tasks of this project, registered under the `name` in their task files."""

from __future__ import annotations

from isaacgymenvs_lite.tasks.allegro_hand import AllegroHand
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.amp.robot_amp import RobotAMP, RobotAMPVelocity
from isaacgymenvs_lite.tasks.ant import Ant
from isaacgymenvs_lite.tasks.anymal import Anymal
from isaacgymenvs_lite.tasks.anymal_terrain import AnymalTerrain
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
from isaacgymenvs_lite.tasks.ball_balance import BallBalance
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.tasks.cartpole import Cartpole
from isaacgymenvs_lite.tasks.franka_cabinet import FrankaCabinet
from isaacgymenvs_lite.tasks.franka_cube_stack import FrankaCubeStack
from isaacgymenvs_lite.tasks.humanoid import Humanoid
from isaacgymenvs_lite.tasks.ingenuity import Ingenuity
from isaacgymenvs_lite.tasks.quadcopter import Quadcopter
from isaacgymenvs_lite.tasks.registry import find_task, isaacgym_task_map, register_task
from isaacgymenvs_lite.tasks.shadow_hand import ShadowHand
from isaacgymenvs_lite.tasks.trifinger import Trifinger

__all__ = ["find_task", "isaacgym_task_map", "register_task"]

_OWN: tuple[type[VecTask], ...] = (
    *(Ant, Anymal, AnymalTerrain, BallBalance, Cartpole, Humanoid, Ingenuity, Quadcopter),
    *(AllegroHand, FrankaCabinet, FrankaCubeStack, ShadowHand, Trifinger),
    *(HumanoidAMP, HumanoidASE, HumanoidASEGetup, HumanoidHeading, HumanoidLocation),
    *(HumanoidPerturb, HumanoidReach, HumanoidStrike, HumanoidViewMotion),
    *(RobotAMP, RobotAMPVelocity),
)
isaacgym_task_map.update({task.__name__: task for task in _OWN})
