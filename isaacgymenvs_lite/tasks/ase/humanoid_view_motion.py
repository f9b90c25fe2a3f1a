"""HumanoidViewMotion: the characters play the clips without physics, as in ASE."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.ase.humanoid_ase import HumanoidASE, HumanoidASEConfig


class HumanoidViewMotion(HumanoidASE):
    """Plays clips without physics. Environment i starts with clip i and then plays the next clips.

    Actions have no effect. A step plays one control step of a clip, and an episode plays one clip.
    """

    def read_settings(self, env: dict[str, Any]) -> HumanoidASEConfig:
        """Return the settings with torque motors, because their controls can be zero."""
        return dataclasses.replace(super().read_settings(env), pd_control=False)

    def simulator_calls(self) -> int:
        """Return 1, because the clips overwrite the result of the physics."""
        return 1

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Run the base method and disable all contacts."""
        super().change_spec(spec)
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0

    def allocate_buffers(self) -> None:
        """Add the ids (N,) of the played clips."""
        super().allocate_buffers()
        clips = torch.arange(self.num_envs, device=self.device)
        self._motion_ids = clips % self.motion_lib.num_motions()

    def action_scaling(self) -> None:
        """Return None, because actions have no effect."""
        return None

    def pre_physics_step(self, actions: Tensor) -> None:
        """Run the base method with zero torques."""
        super().pre_physics_step(torch.zeros_like(actions))

    def post_physics_step(self) -> None:
        """Put the characters into their clips' states at this step, then run the base method."""
        env_ids = torch.arange(self.num_envs, device=self.device)
        self._show(env_ids, self.progress_buf + 1)
        super().post_physics_step()

    def _show(self, env_ids: Tensor, steps: Tensor) -> None:
        motion_ids = self._motion_ids.index_select(0, env_ids)
        state = self.motion_lib.get_motion_state(motion_ids, steps * self.control_dt_s)
        root_states = torch.zeros(len(env_ids), 13, device=self.device)
        root_states[:, :3], root_states[:, 3:7] = state.root_pos, state.root_rot
        at_rest = torch.zeros_like(state.dof_vel)
        self.simulation.write_state(env_ids, root_states, state.dof_pos, at_rest)

    def compute_failures(self) -> Tensor:
        """Return False (N,), because playing a clip cannot fail."""
        return torch.zeros_like(self.timeout_buf)

    def compute_time_outs(self) -> Tensor:
        """Return which clips (N,) are over."""
        lengths = self.motion_lib.get_motion_length(self._motion_ids)
        return self.progress_buf * self.control_dt_s > lengths

    def reset_state(self, env_ids: Tensor) -> None:
        """Start the next clip of each environment, or its first clip in a first episode."""
        is_over = self.progress_buf.index_select(0, env_ids) > 0
        clips = self._motion_ids.index_select(0, env_ids) + is_over * self.num_envs
        self._motion_ids.index_copy_(0, env_ids, clips % self.motion_lib.num_motions())
        self._show(env_ids, torch.zeros_like(env_ids))
        self._reference_env_ids = env_ids[:0]
        self.goal.reset(env_ids)
