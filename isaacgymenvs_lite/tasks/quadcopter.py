"""Quadcopter: a body with four tilting rotors hovers 1 m above the ground, as in IsaacGymEnvs.

The task keeps two quirks: one full action moves a thrust from zero to its maximum, and the thrusts
are not observed.

Each rotor has two hinges, whose drives have a stiffness of 1000 Nm/rad and no damping. Implicit
integration (see the module `drives`) makes the drives stable. In steps of 0.005 s it adds an
armature of 0.025 kg m^2 and a damping of 5 Nm s/rad. A hinge reaches its target in one step.
"""

from __future__ import annotations

import math

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.base.assets import hinge_limits
from isaacgymenvs_lite.tasks.base.drives import integrate_drives_implicitly
from isaacgymenvs_lite.tasks.base.hover import (
    HOME_M,
    HoverConfig,
    HoverTask,
    compute_hover_reward,
    draw_start_states,
)
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms

_NUM_HINGES = 8
_NUM_ROTORS = 4
_HINGE_SPEED_RAD_S = 8.0 * math.pi  # speed of a hinge target, from a full action
_THRUST_SPEED_N_S = 200.0  # rate of a thrust, from a full action
_MAX_THRUST_N = 2.0
_START_ANGLE_RAD = 0.2


def compute_quadcopter_reward(to_target: Tensor, root_rot: Tensor, spin: Tensor) -> Terms:
    """Return reward terms (N,), whose sum is at most 3 (see `compute_hover_reward`)."""
    return compute_hover_reward(to_target, root_rot, spin, upright_weight=1.0)


class Quadcopter(HoverTask):
    """N quadcopters with 21 observations and 12 actions.

    The observations consist of `compute_flight_observations` and the 8 hinge angles (rad). The
    actions are the speeds of the 8 hinge targets and the rates of the 4 thrusts.
    """

    settings_class = HoverConfig
    default_asset = "mjcf/quadcopter.xml"
    actor_name = "quadcopter"
    num_observations = 21
    num_actions = _NUM_HINGES + _NUM_ROTORS
    max_distance_m = 3.0
    min_height_m = 0.3

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Integrate the undamped drives implicitly, which makes them stable."""
        integrate_drives_implicitly(spec, self.sim_cfg.dt / self.sim_cfg.substeps)

    def create_sim(self) -> None:
        """Create the simulations and look up the limits of the hinges."""
        super().create_sim()
        limits = torch.from_numpy(hinge_limits(self._model, self._layout)).float()
        self._lower, self._upper = limits.to(self.device).unbind(-1)
        self._target_pos = torch.tensor(HOME_M, device=self.device)

    def allocate_buffers(self) -> None:
        """Add position targets and thrusts."""
        super().allocate_buffers()
        self.targets = torch.zeros(self.num_envs, _NUM_HINGES, device=self.device)  # rad
        self.thrusts = torch.zeros(self.num_envs, _NUM_ROTORS, device=self.device)  # newton

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Change hinge targets (rad) and thrusts (newton) by the actions, and return both."""
        self.targets += actions[:, :_NUM_HINGES] * (_HINGE_SPEED_RAD_S * self.sim_dt_s)
        self.targets.clamp_(self._lower, self._upper)
        self.thrusts += actions[:, _NUM_HINGES:] * (_THRUST_SPEED_N_S * self.sim_dt_s)
        self.thrusts.clamp_(0.0, _MAX_THRUST_N)
        return torch.cat((self.targets, self.thrusts), dim=-1)

    def to_target(self) -> Tensor:
        """Return the vectors (N, 3) in m to the point 1 m above the origin."""
        return self._target_pos - self.simulation.root_states[:, :3]

    def observation_groups(self) -> dict[str, int]:
        """See the class docstring."""
        return super().observation_groups() | {"dof_pos": _NUM_HINGES}

    def compute_obs(self) -> Tensor:
        """See the class docstring."""
        return torch.cat((super().compute_obs(), self.simulation.dof_pos), dim=-1)

    def compute_reward_terms(self) -> Terms:
        """See `compute_quadcopter_reward`."""
        root = self.simulation.root_states
        return compute_quadcopter_reward(self.to_target(), root[:, 3:7], root[:, 12])

    def reset_state(self, env_ids: Tensor) -> None:
        """Place the quadcopters near the target and at rest, with tilted rotors and no thrust."""
        pos = uniform(env_ids, -_START_ANGLE_RAD, _START_ANGLE_RAD, (_NUM_HINGES,))
        root = draw_start_states(env_ids)
        self.simulation.write_state(env_ids, root, pos, torch.zeros_like(pos))
        self.targets.index_copy_(0, env_ids, pos)
        self.thrusts.index_fill_(0, env_ids, 0.0)
