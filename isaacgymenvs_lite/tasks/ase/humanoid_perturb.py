"""HumanoidPerturb: boxes are thrown at a trained character, as in ASE."""

from __future__ import annotations

import itertools
import math

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.ase.humanoid_ase import HumanoidASE
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.goals.boxes import add_box
from isaacgymenvs_lite.utils.rotations import normalize

_SMALL, _LARGE = (0.2, 200.0), (0.5, 100.0)  # edge (m) and density (kg/m^3)
# A throw is a kind of box and a number of control steps since the previous throw.
_THROWS = (
    *((_SMALL, wait) for wait in (60, 7, 10, 35, 2, 2, 3, 2, 2, 3, 2)),
    (_LARGE, 60),
    (_SMALL, 300),
)
_PARKED_AT_M = (200.0, 0.0, 1.0)
_DISTANCE_M, _HEIGHT_M, _SPEED_M_S = (4.0, 5.0), (0.25, 2.0), (30.0, 40.0)
_AIM_NOISE_M = 0.1
_AIMED_AT = "torso"


def throw_steps() -> tuple[int, ...]:
    """Return the control steps at which the boxes are thrown, in order."""
    return tuple(itertools.accumulate(wait for _, wait in _THROWS))


class HumanoidPerturb(HumanoidASE):
    """A robustness test of a trained policy, whose episodes end only at the time limit.

    Twelve boxes of 1.6 kg and one box of 12.5 kg come from random sides at 30 to 40 m/s. The
    control step in the episode of the first environment determines when a box is thrown.
    """

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Run the base method and add the boxes far away."""
        super().change_spec(spec)
        x, y, z = _PARKED_AT_M
        for i, ((edge, density), _) in enumerate(_THROWS):
            add_box(spec, f"box_{i}", (edge, edge, edge), density, (x + i, y, z))

    def create_sim(self) -> None:
        """Create the simulations and look up the boxes."""
        super().create_sim()
        self._aim_body = self.simulation.body_names.index(_AIMED_AT)
        names = self.simulation.object_names
        self._box_at_step = {step: names.index(f"box_{i}") for i, step in enumerate(throw_steps())}

    def pre_physics_step(self, actions: Tensor) -> None:
        """Run the base method and throw the box that is due."""
        super().pre_physics_step(actions)
        clock = int(self.progress_buf[0]) % (throw_steps()[-1] + 1)
        if clock in self._box_at_step:
            self.throw(self._box_at_step[clock])

    def throw(self, box: int) -> None:
        """Throw the object with index `box` in `simulation.object_names` at all characters."""
        env_ids = torch.arange(self.num_envs, device=self.device)
        sim = self.simulation
        torso, root = sim.body_pos[:, self._aim_body], sim.root_states[:, :3]
        bearing, distance = uniform(env_ids, 0.0, math.tau), uniform(env_ids, *_DISTANCE_M)
        states = torch.zeros(self.num_envs, 13, device=self.device)
        states[:, 0] = root[:, 0] + distance * bearing.cos()
        states[:, 1] = root[:, 1] - distance * bearing.sin()
        states[:, 2] = uniform(env_ids, *_HEIGHT_M)
        states[:, 6] = 1.0
        aim = torso - states[:, :3] + _AIM_NOISE_M * torch.randn_like(torso)
        states[:, 7:10] = uniform(env_ids, *_SPEED_M_S).unsqueeze(-1) * normalize(aim)
        states[:, 7:9] += sim.body_lin_vel[:, self._aim_body, :2]
        sim.write_object_states(
            env_ids, torch.tensor([box], device=self.device), states.unsqueeze(1)
        )

    def compute_failures(self) -> Tensor:
        """Return False (N,), because falls do not end episodes."""
        return torch.zeros_like(self.timeout_buf)
